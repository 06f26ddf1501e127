/* The kernels in C against loops in float64, as a program: for processors that only an emulator runs on.
 *
 * Compiled together with the kernels; prints the largest error of each and ends with status 1 if one is too large. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../../../nlfilter_torch/core/kernels/interface.h"

enum { B = 2, N = 1237, D = 5, M = 29, J = 3, R = 3, S = 400 }; /* sizes: none is a multiple of another */

static float x[B][D][N], z[B][D][M], centre[B][D], rows[B][M][D + 2], inverse[B][M][M], factor[B][M][N], norms[B][N];
static float right[B][M][N], left[B][M][R], scale[B][N], diagonal[B][N], points[B][D + 1][M], moved[B][D][N];
static float images[B][R][N], vectors[B][R][M], scaling[B][N], remainder_[B][N], spread[B][R][N], out[B][N], row[B][M];
static double aff[B][M][N], exact[B][M][N], lengths[B][N], totals[B][M * (M + D + 1)], sums[B][J * M * M];
static int failures;

static float draw(float least, float most)
{
    static unsigned long long state = 88172645463325252ull;
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return least + (most - least) * (float)(state >> 40) / (1 << 24);
}

static void fill(float *array, size_t bytes, float least, float most)
{
    for (size_t k = 0; k < bytes / sizeof(float); k++)
        array[k] = draw(least, most);
}

static double worst, largest;

static void compare(double actual, double wanted)
{
    const double error = fabs(actual - wanted);
    worst = isnan(worst) || error <= worst ? worst : error; /* NaN stays */
    largest = fabs(wanted) > largest ? fabs(wanted) : largest;
}

static void judge(const char *name, int status, double allowed)
{
    const int fine = status == 0 && worst <= allowed * largest && largest > 0;
    printf("%-10s %s: off by %.1e of %.1e\n", name, fine ? "right" : "WRONG", worst, largest);
    failures += !fine;
    worst = largest = 0;
}

static void check_columns(int level, int threads, int limited)
{
    const int status = nlfilter_columns(level, threads, N, B, D, M, x[0][0], D * N, N, centre[0], rows[0][0],
                                        inverse[0][0], -100.0f, limited, factor[0][0], M * N, N, norms[0]);
    for (int b = 0; b < B; b++)
        for (int i = 0; i < N; i++) {
            lengths[b][i] = 0;
            for (int m = 0; m < M; m++) {
                double distance = 0, sum = 0;
                for (int k = 0; k < D; k++)
                    distance += pow(x[b][k][i] - centre[b][k] - z[b][k][m], 2);
                aff[b][m][i] = exp(-distance);
                for (int j = 0; j <= m; j++)
                    sum += inverse[b][m][j] * aff[b][j][i];
                exact[b][m][i] = sum;
                lengths[b][i] += sum * sum;
            }
            scale[b][i] = limited && lengths[b][i] > 1 ? 1 / sqrt(lengths[b][i]) : 1;
            for (int m = 0; m < M; m++)
                compare(factor[b][m][i], exact[b][m][i] *= scale[b][i]);
            if (limited)
                compare(norms[b][i], lengths[b][i]);
        }
    judge(limited ? "columns |" : "columns", status, 2e-6);
}

static void check_backward(int level, int threads, int limited, int rank)
{
    const float *first = rank == M ? NULL : left[0][0];
    const int status = nlfilter_backward(level, threads, N, B, D, M, x[0][0], D * N, N, centre[0], rows[0][0],
                                         inverse[0][0], -100.0f, limited, factor[0][0], M * N, N, scale[0], rank,
                                         first, right[0][0], M * N, N, diagonal[0], points[0][0], moved[0][0],
                                         totals[0]);
    static double wanted[M * (M + D + 1)];
    for (int b = 0; b < B; b++) {
        memset(wanted, 0, sizeof wanted);
        for (int i = 0; i < N; i++) {
            double g[M], along = 0, pull[M], pulled = 0;
            for (int m = 0; m < M; m++) {
                g[m] = first ? 0 : right[b][m][i];
                for (int r = 0; first && r < rank; r++)
                    g[m] += left[b][m][r] * right[b][r][i];
                along += factor[b][m][i] * g[m];
            }
            along = scale[b][i] < 1 ? along : 2 * diagonal[b][i];
            for (int m = 0; limited && m < M; m++)
                g[m] = (g[m] - factor[b][m][i] * along) * scale[b][i];
            for (int m = 0; m < M; m++) {
                pull[m] = 0;
                for (int j = m; j < M; j++)
                    pull[m] += inverse[b][j][m] * g[j];
                pulled += pull[m] *= aff[b][m][i];
                for (int j = 0; j <= m; j++)
                    wanted[m * M + j] += g[m] * aff[b][j][i];
            }
            for (int k = 0; k < D; k++) {
                double sum = -2 * (x[b][k][i] - centre[b][k]) * pulled;
                for (int m = 0; m < M; m++) {
                    sum += 2 * z[b][k][m] * pull[m];
                    wanted[M * M + m * (D + 1) + k] += pull[m] * (x[b][k][i] - centre[b][k]);
                }
                compare(moved[b][k][i], sum);
            }
            for (int m = 0; m < M; m++)
                wanted[M * M + m * (D + 1) + D] += pull[m];
        }
        for (int k = 0; k < M * (M + D + 1); k++)
            if (k >= M * M || k % M <= k / M)
                compare(totals[b][k], wanted[k]);
    }
    judge(limited ? "backward |" : "backward", status, 2e-6);
}

static void check_products(int level, int threads)
{
    int status = nlfilter_spread(level, threads, N, B, M, factor[0][0], M * N, N, R, vectors[0][0], scaling[0],
                                 spread[0][0]);
    for (int b = 0; b < B; b++)
        for (int r = 0; r < R; r++)
            for (int i = 0; i < N; i++) {
                double sum = 0;
                for (int m = 0; m < M; m++)
                    sum += vectors[b][r][m] * factor[b][m][i];
                compare(spread[b][r][i], sum * scaling[b][i]);
            }
    judge("spread", status, 2e-6);
    status = nlfilter_gather(level, threads, N, B, M, factor[0][0], M * N, N, R, images[0][0], R * N, N, totals[0]);
    for (int b = 0; b < B; b++)
        for (int k = 0; k < R * M; k++) {
            double sum = 0;
            for (int i = 0; i < N; i++)
                sum += images[b][k / M][i] * factor[b][k % M][i];
            compare(((double *)totals)[b * R * M + k], sum);
        }
    judge("gather", status, 2e-6);
    for (int balanced = 0; balanced < 2; balanced++) {
        status = nlfilter_sweep(level, threads, N, B, M, factor[0][0], M * N, N, row[0], balanced ? NULL : scaling[0],
                                balanced ? diagonal[0] : NULL, NULL, 3.0f, out[0], totals[0]);
        for (int b = 0; b < B; b++) {
            double moment[M] = {0};
            for (int i = 0; i < N; i++) {
                double value = 0;
                for (int m = 0; m < M; m++)
                    value += row[b][m] * factor[b][m][i];
                value = balanced ? fmin(3.0, 1 / (value + sqrt(value * value + diagonal[b][i]))) : value * scaling[b][i];
                compare(out[b][i], value);
                for (int m = 0; m < M; m++)
                    moment[m] += value * factor[b][m][i];
            }
            for (int m = 0; m < M; m++)
                compare(((double *)totals)[b * M + m], moment[m]);
        }
        judge(balanced ? "sweep" : "weigh", status, 2e-6);
    }
    status = nlfilter_grams(level, threads, N, B, M, factor[0][0], M * N, N, J, scaling[0], remainder_[0], sums[0]);
    for (int b = 0; b < B; b++)
        for (int k = 0; k < J * M * M; k++) {
            double sum = 0;
            for (int i = 0; i < N; i++)
                sum += factor[b][k / M % M][i] * factor[b][k % M][i] * pow(scaling[b][i], 2) *
                       pow(remainder_[b][i], k / (M * M));
            compare(sums[b][k], sum);
        }
    judge("grams", status, 2e-6);
}

/* A scaling balances the kernel whose unit diagonal is completed; the solution of a system meets its equations. */
static void check_balancing(int level, int threads, int counts)
{
    static float kernel[B][M][N], rest[B][N], weights[B][N], residual[B];
    static double moment[B][M], inverse_[B][M][M], left_over[B];
    static long explored[N / 4], steps[B];
    fill(weights[0], sizeof weights, 0, 2);
    for (int i = 0; i < N / 4; i++)
        explored[i] = 4 * i;
    for (int b = 0; b < B; b++)
        for (int i = 0; i < N; i++) {
            double length = 0;
            for (int m = 0; m < M; m++)
                length += pow(factor[b][m][i], 2);
            for (int m = 0; m < M; m++)
                kernel[b][m][i] = fabs(factor[b][m][i]) / sqrt(length + 1);
            rest[b][i] = 1 / (length + 1);
        }
    int status = nlfilter_balance(level, threads, N, B, M, kernel[0][0], M * N, N, rest[0], counts ? weights[0] : NULL,
                                  counts ? explored : NULL, counts ? N / 4 : 0, counts ? N / 3 : N, 1e-6f, out[0],
                                  moment[0], residual, inverse_[0][0], steps);
    for (int b = 0; b < B; b++) {
        double sums_[M] = {0};
        for (int i = 0; i < N; i++)
            for (int m = 0; m < M; m++)
                sums_[m] += kernel[b][m][i] * out[b][i] * (counts ? weights[b][i] : 1);
        for (int i = 0; i < N; i++) {
            double sum = rest[b][i] * out[b][i];
            for (int m = 0; m < M; m++)
                sum += kernel[b][m][i] * sums_[m];
            compare(sum * out[b][i], 1);
        }
        for (int m = 0; m < M; m++)
            compare(moment[b][m] / sums_[m], 1);
    }
    judge("balance", status, 1e-5);
    status = nlfilter_conjugate(level, threads, N, B, M, kernel[0][0], M * N, N, rest[0], moment[0], inverse_[0][0], 50,
                                1e-7, totals[0], left_over);
    for (int b = 0; b < B; b++) {
        const double *solution = (double *)totals + b * M;
        double sums_[M] = {0};
        for (int i = 0; i < N; i++) {
            double product = 0;
            for (int m = 0; m < M; m++)
                product += kernel[b][m][i] * solution[m];
            for (int m = 0; m < M; m++)
                sums_[m] += kernel[b][m][i] * product * rest[b][i];
        }
        for (int m = 0; m < M; m++)
            compare(solution[m] + sums_[m], moment[b][m]);
    }
    judge("conjugate", status, 1e-5);
}

static void check_landmarks(int level, int threads)
{
    static float samples[B][D][S], start[B][D][M], draws[M][TRIALS];
    static int nearest[B][S];
    static long pivots[B][M];
    fill(samples[0][0], sizeof samples, -1, 1);
    fill(draws[0], sizeof draws, 0, 1);
    for (int b = 0; b < B; b++)
        for (int k = 0; k < D; k++)
            memcpy(start[b][k], samples[b][k], M * sizeof(float));
    int status = nlfilter_lloyd(level, threads, B, D, S, M, 0, 1e-6f, samples[0][0], start[0][0], nearest[0]);
    for (int b = 0; b < B; b++)
        for (int i = 0; i < S; i++) {
            double least = INFINITY, chosen = 0;
            for (int m = 0; m < M; m++) {
                double distance = 0;
                for (int k = 0; k < D; k++)
                    distance += pow(samples[b][k][i] - start[b][k][m], 2);
                least = distance < least ? distance : least;
                chosen = nearest[b][i] == m ? distance : chosen;
            }
            compare(chosen, least);
        }
    judge("lloyd", status, 1e-5);
    status = nlfilter_pivots(level, threads, B, D, S, M, 1e-6f, samples[0][0], draws[0], pivots[0]);
    for (int b = 0; b < B; b++) {
        static double column[M][S], residual[S], nearest_pivot[S];
        for (int i = 0; i < S; i++) {
            residual[i] = 1;
            nearest_pivot[i] = UNCOVERED;
        }
        for (int m = 0, width, first = 0; m < M; m++) {
            width = 2 * first > FIRST ? 2 * first : FIRST; /* pivots in the block that begins with the first */
            width = M - first < width ? M - first : width;
            const long pivot = pivots[b][m];
            const int half = width * TRIALS / 2;
            double apart = INFINITY, at = 0, reached = 0; /* of the proposal whose share is nearest to its draw */
            for (int t = 0; t < 2 * half; t++) {
                double whole = 0, before = 0, own = 0;
                for (int i = 0; i < S; i++) {
                    own = pow(fmax(residual[i], 1e-6), 4) * (t < half ? pow(nearest_pivot[i] + DISTINCT, 2) : 1);
                    whole += own;
                    before += i <= pivot ? own : 0;
                }
                own = pow(fmax(residual[pivot], 1e-6), 4) * (t < half ? pow(nearest_pivot[pivot] + DISTINCT, 2) : 1);
                const double tick = (t % half + draws[first + t / TRIALS][t % TRIALS]) / half;
                const double end = fmin(fmax(tick, (before - own) / whole), before / whole);
                if (fabs(end - tick) < apart) {
                    apart = fabs(end - tick);
                    at = tick;
                    reached = end;
                }
            }
            compare(reached, at); /* the draw is within the share of the pivot */
            if (m + 1 < first + width)
                continue;
            for (int j = first; j < first + width; j++) {
                const long at_pivot = pivots[b][j];
                for (int i = 0; i < S; i++) {
                    double distance = 0;
                    for (int k = 0; k < D; k++)
                        distance += pow(samples[b][k][i] - samples[b][k][at_pivot], 2);
                    column[j][i] = exp(-distance);
                    nearest_pivot[i] = fmin(nearest_pivot[i], distance);
                    for (int k = 0; k < j; k++)
                        column[j][i] -= column[k][i] * column[k][at_pivot];
                }
                const double root = sqrt(column[j][at_pivot] + 1e-6);
                for (int i = 0; i < S; i++) {
                    column[j][i] /= root;
                    residual[i] -= column[j][i] * column[j][i];
                }
            }
            first += width;
        }
    }
    judge("pivots", status, 1e-4);
}

static void check_convolution(int level, int threads, int apart, int adds)
{
    enum { H = 13, W = 10, C = 16, O = 21, PADDED = 32 };
    static float features[B][H][W][C], kernel[O][C][3][3], weights[6][6][C][PADDED], bias[PADDED], added[B][H][W][O];
    static float results[B][H][W][O];
    const double values[6][3] = {{1 / 4.0, 0, 0},           {-1 / 6.0, -1 / 6.0, -1 / 6.0}, {-1 / 6.0, 1 / 6.0, -1 / 6.0},
                                 {1 / 24.0, 1 / 12.0, 1 / 6.0}, {1 / 24.0, -1 / 12.0, 1 / 6.0}, {0, 0, 1}};
    fill(features[0][0][0], sizeof features, -1, 1);
    fill(kernel[0][0][0], sizeof kernel, -1, 1);
    fill(bias, O * sizeof(float), -1, 1);
    fill(added[0][0][0], sizeof added, -1, 1);
    for (int k = 0; k < 36 * C * O; k++) {
        const int i = k / (6 * C * O), j = k / (C * O) % 6, c = k / O % C, o = k % O;
        double sum = 0;
        for (int l = 0; l < 9; l++)
            sum += values[i][l / 3] * values[j][l % 3] * kernel[o][c][l / 3][l % 3];
        weights[i][j][c][o] = sum;
    }
    const int status = nlfilter_convolution(level, threads, B, H, W, C, O, PADDED, apart, 0.1f, features[0][0][0],
                                            weights[0][0][0], bias, adds ? added[0][0][0] : NULL, results[0][0][0]);
    for (int k = 0; k < B * H * W * O; k++) {
        const int b = k / (H * W * O), y = k / (W * O) % H, x_ = k / O % W, o = k % O;
        double sum = bias[o] + (adds ? added[b][y][x_][o] : 0);
        for (int l = 0; l < 9 * C; l++) {
            const int row = y + (l / 3 % 3 - 1) * apart, column = x_ + (l % 3 - 1) * apart;
            if (row < 0 || row >= H || column < 0 || column >= W)
                continue;
            const double value = features[b][row][column][l / 9];
            sum += kernel[o][l / 9][l / 3 % 3][l % 3] * (value < 0 ? 0.1f * value : value);
        }
        compare(results[b][y][x_][o], sum);
    }
    judge("convolution", status, 1e-5);
}

/* Along the axis of the largest coordinate within the cell, then of the middle, then of the least. */
static void check_lattice(int level, int threads)
{
    enum { NODES = 9 };
    static float colours[B][3][N], lattice[B][NODES][NODES][NODES][4], values[B][3][N];
    fill(colours[0][0], sizeof colours, -0.2f, 1.2f);
    fill(lattice[0][0][0][0], sizeof lattice, -1, 1);
    const int status = nlfilter_lattice(level, threads, N, B, NODES, colours[0][0], 3 * N, N, lattice[0][0][0][0],
                                        NODES * NODES * NODES * 4, values[0][0]);
    for (int k = 0; k < B * 3 * N; k++) {
        const int b = k / (3 * N), c = k / N % 3, i = k % N;
        double parts[3], sum;
        int node[3];
        for (int a = 0; a < 3; a++) {
            const double place = fmin(fmax(colours[b][a][i], 0), 1) * (NODES - 1);
            node[a] = fmin(floor(place), NODES - 2);
            parts[a] = place - node[a];
        }
        sum = lattice[b][node[0]][node[1]][node[2]][c];
        for (int step = 0; step < 3; step++) {
            const double before = lattice[b][node[0]][node[1]][node[2]][c];
            int axis = 0;
            for (int a = 1; a < 3; a++)
                axis = parts[a] > parts[axis] ? a : axis;
            node[axis]++;
            sum += parts[axis] * (lattice[b][node[0]][node[1]][node[2]][c] - before);
            parts[axis] = -1;
        }
        compare(values[b][c][i], sum);
    }
    judge("lattice", status, 1e-5);
}

/* Each equation holds for the solution. */
static void check_stencil(int level, int threads)
{
    enum { H = 23, W = 40, C = 3 };
    static double stencil[B][9][H][W], sides[B][C][H][W], results[B][C][H][W];
    for (int k = 0; k < B * C * H * W; k++)
        sides[k / (C * H * W)][k / (H * W) % C][k / W % H][k % W] = draw(-1, 1);
    for (int k = 0; k < B * H * W; k++) {
        const int b = k / (H * W), y = k / W % H, x_ = k % W;
        stencil[b][4][y][x_] = 0;
        for (int l = 0; l < 9; l++)
            if (l != 4) {
                stencil[b][l][y][x_] = draw(-1, 0.4f);
                stencil[b][4][y][x_] += fabs(stencil[b][l][y][x_]);
            }
    }
    const int status = nlfilter_stencil(level, threads, B, H, W, C, stencil[0][0][0], sides[0][0][0], results[0][0][0]);
    for (int k = 0; k < B * C * H * W; k++) {
        const int b = k / (C * H * W), c = k / (H * W) % C, y = k / W % H, x_ = k % W;
        double sum = 0;
        for (int l = 0; l < 9; l++) {
            const int row = y + l / 3 - 1, column = x_ + l % 3 - 1;
            if (row >= 0 && row < H && column >= 0 && column < W)
                sum += stencil[b][l][y][x_] * results[b][c][row][column];
        }
        compare(sum, sides[b][c][y][x_]);
    }
    judge("stencil", status, 1e-12);
}

int main(void)
{
    fill(x[0][0], sizeof x, -1, 1);
    fill(centre[0], sizeof centre, -0.2f, 0.2f);
    fill(z[0][0], sizeof z, -1, 1);
    fill(inverse[0][0], sizeof inverse, -0.5f, 0.5f);
    fill(right[0][0], sizeof right, -1, 1);
    fill(left[0][0], sizeof left, -1, 1);
    fill(diagonal[0], sizeof diagonal, 0.1f, 1);
    fill(images[0][0], sizeof images, -1, 1);
    fill(vectors[0][0], sizeof vectors, -1, 1);
    fill(scaling[0], sizeof scaling, 0.1f, 1);
    fill(remainder_[0], sizeof remainder_, 0, 1);
    fill(row[0], sizeof row, 0, 1);
    for (int b = 0; b < B; b++)
        for (int m = 0; m < M; m++) {
            double length = 0;
            for (int k = 0; k < D; k++) {
                length += z[b][k][m] * z[b][k][m];
                rows[b][m][k] = 2 * z[b][k][m] * 1.4426950408889634;
                points[b][k][m] = 2 * z[b][k][m];
            }
            rows[b][m][D] = -length * 1.4426950408889634;
            rows[b][m][D + 1] = -1.4426950408889634;
            points[b][D][m] = 2;
            for (int j = m + 1; j < M; j++)
                inverse[b][m][j] = 0;
        }
    printf("instruction sets: %d\n", nlfilter_level());
    for (int level = 1; level <= nlfilter_level(); level++)
        for (int threads = 1; threads <= 3; threads += 2) {
            printf("level %d, threads %d\n", level, threads);
            for (int limited = 0; limited < 2; limited++) {
                check_columns(level, threads, limited);
                check_backward(level, threads, limited, M);
                check_backward(level, threads, limited, R);
            }
            check_products(level, threads);
            check_balancing(level, threads, 0);
        check_balancing(level, threads, 1);
        check_landmarks(level, threads);
            for (int apart = 1; apart <= 5; apart++)
                check_convolution(level, threads, apart, apart % 2);
            check_lattice(level, threads);
            check_stencil(level, threads);
        }
    return failures != 0;
}
