/* Choice of landmarks; defined in clusters.py. */

/* Nearest of the packed centres (c, -|c|^2 / 2) to each point x of (D, S): the centre with the largest score
 * x . c - |c|^2 / 2. Scores within rounding of each other are ties; the first index wins. sums (M, D + 1) += the sum
 * of the points of each cluster, and their number. */
static TARGET void NAME(assign)(const struct lloyd *task, const float *points, const float *centres, float *tile,
                                int *nearest, float *sums)
{
    const long size = task->size, count = task->count;
    for (int v = 0; v < VECTORS; v++)
        *(FLOATS *)(tile + size * PIXELS + v * LANES) = (FLOATS){0} + 1.0f;
    for (long start = 0; start < count; start += PIXELS) {
        const long width = count - start < PIXELS ? count - start : PIXELS;
        for (long k = 0; k < size; k++) {
            memcpy(tile + k * PIXELS, points + k * count + start, width * sizeof(float));
            memset(tile + k * PIXELS + width, 0, (PIXELS - width) * sizeof(float));
        }
        FLOATS bar[VECTORS], slack[VECTORS]; /* best score plus its rounding margin; the margin's part due to x */
        INTS chosen[VECTORS];
        for (int v = 0; v < VECTORS; v++) {
            bar[v] = (FLOATS){0} - INFINITY;
            chosen[v] = (INTS){0};
            slack[v] = (FLOATS){0};
            for (long k = 0; k < size; k++)
                slack[v] += *(FLOATS *)(tile + k * PIXELS + v * LANES) * *(FLOATS *)(tile + k * PIXELS + v * LANES);
            slack[v] *= task->margin;
        }
        for (long m = 0; m < task->num_landmarks; m += ROWS) {
            FLOATS scores[ROWS][VECTORS];
            NAME(multiply)(centres + m * (size + 1), tile, size + 1, scores);
            for (int r = 0; r < ROWS; r++)
                for (int v = 0; v < VECTORS; v++) {
                    const INTS better = scores[r][v] > bar[v];
                    const FLOATS length = (FLOATS)((INTS)scores[r][v] & INT32_MAX);
                    const FLOATS next = scores[r][v] + (slack[v] + task->margin * length);
                    bar[v] = (FLOATS)(((INTS)next & better) | ((INTS)bar[v] & ~better));
                    chosen[v] = (((INTS){0} + (int)(m + r)) & better) | (chosen[v] & ~better);
                }
        }
        for (long i = 0; i < width; i++) {
            const int centre = chosen[i / LANES][i % LANES];
            nearest[start + i] = centre;
            for (long k = 0; k <= size; k++)
                sums[centre * (size + 1) + k] += tile[k * PIXELS + i];
        }
    }
}

/* out (S) += sign * sum over r of left[r * step] * row r of right (R, S), four rows per pass. */
INLINE void NAME(accumulate)(const float *left, long step, const float *right, long rows, long count, float sign,
                             float *out)
{
    for (long r = 0; r < rows; r += 4) {
        const float *row[4];
        float weight[4];
        for (long k = 0; k < 4; k++) {
            row[k] = right + (r + k < rows ? r + k : r) * count;
            weight[k] = r + k < rows ? sign * left[(r + k) * step] : 0.0f;
        }
        for (long i = 0; i < count; i++)
            out[i] += weight[0] * row[0][i] + weight[1] * row[1][i] + weight[2] * row[2][i] + weight[3] * row[3][i];
    }
}

/* Probabilities of a point in the two random draws, not normalised: the fourth power of its residual, first times the
 * fourth power of the distance from the nearest pivot, then alone. */
INLINE void NAME(pivot_odds)(const struct pivots *task, const float *residual, const float *nearest, float *odds)
{
    const long count = task->count;
    for (long i = 0; i < count; i++) {
        const float rest = residual[i] > task->captured ? residual[i] : task->captured;
        const float chance = i < task->used ? (rest * rest) * (rest * rest) : 0.0f;
        odds[i] = chance * (nearest[i] + DISTINCT) * (nearest[i] + DISTINCT);
        odds[count + i] = chance;
    }
}

/* Sums of odds of LINE points each; returns their sum. */
INLINE double NAME(sum_blocks)(const float *odds, long count, double *blocks)
{
    double total = 0.0;
    for (long b = 0; b < count / LINE; b++) {
        double sums[8] = {0.0};
        for (long i = b * LINE; i < (b + 1) * LINE; i += 8)
            for (int k = 0; k < 8; k++)
                sums[k] += odds[i + k];
        blocks[b] = 0.0;
        for (int k = 0; k < 8; k++)
            blocks[b] += sums[k];
        total += blocks[b];
    }
    return total;
}

/* Index of the point where the sum of odds reaches `tick`. `blocks` (S / LINE) holds the sums of odds of LINE points. */
INLINE long NAME(drawn)(const float *odds, const double *blocks, long used, long count, double tick)
{
    double reached = 0.0;
    long block = 0;
    for (; block < count / LINE - 1 && reached + blocks[block] < tick; block++)
        reached += blocks[block];
    long point = block * LINE;
    const long last = (point + LINE < used ? point + LINE : used) - 1;
    for (; point < last; point++) {
        reached += odds[point];
        if (reached >= tick)
            break;
    }
    return point;
}

/* Squared distances (TRIALS, S) of all points from those proposed. */
INLINE void NAME(distances)(const struct pivots *task, const float *points, const float *norms, const long *proposed,
                            float *distances)
{
    const long size = task->size, count = task->count;
    for (long i = 0; i < count; i += LANES) {
        FLOATS inner[TRIALS];
        for (int t = 0; t < TRIALS; t++)
            inner[t] = (FLOATS){0};
        for (long k = 0; k < size; k++) {
            const float *plane = points + k * count;
            const FLOATS here = *(const FLOATS *)(plane + i);
            for (int t = 0; t < TRIALS; t++)
                inner[t] += plane[proposed[t]] * here;
        }
        for (int t = 0; t < TRIALS; t++)
            *(FLOATS *)(distances + t * count + i) = NAME(clamp)(
                *(const FLOATS *)(norms + i) + norms[proposed[t]] - 2.0f * inner[t], 0.0f, FLT_MAX);
    }
}

/* Sum over the points of the larger of two rows. The first becomes that, if `kept`; the second, if `squares`, holds
 * squared distances, and then how well they cover the points. */
INLINE double NAME(larger)(long count, float *reached, float *row, const int kept, const int squares)
{
    double total = 0.0;
    for (long start = 0; start < count; start += LINE) {
        FLOATS sum = {0};
        for (long i = start; i < start + LINE; i += LANES) {
            FLOATS here = *(const FLOATS *)(row + i);
            if (squares)
                *(FLOATS *)(row + i) = here = COVERED / (here + COVERED);
            const FLOATS before = *(const FLOATS *)(reached + i);
            const INTS more = here > before;
            const FLOATS most = (FLOATS)(((INTS)here & more) | ((INTS)before & ~more));
            sum += most;
            if (kept)
                *(FLOATS *)(reached + i) = most;
        }
        for (int lane = 0; lane < LANES; lane++)
            total += sum[lane];
    }
    return total;
}

/* The proposals (P) for pivots in the order of what they add to the better ones, rounded, so that rounding of sums does
 * not decide. Writes how well they cover the points to `rows` (P, S). */
INLINE void NAME(propose)(const struct pivots *task, const float *points, const float *norms, const long *proposed,
                          long total, const float *nearest, float *reached, float *rows, struct proposal *proposals)
{
    const long count = task->count;
    const double unit = NEARLY * task->used;
    for (long i = 0; i < count; i++)
        reached[i] = COVERED / (nearest[i] + COVERED);
    const double before = NAME(larger)(count, reached, reached, 0, 0);
    for (long p = 0; p < total; p++) {
        if (p % TRIALS == 0)
            NAME(distances)(task, points, norms, proposed + p, rows + p * count);
        const double sum = NAME(larger)(count, reached, rows + p * count, 0, 1);
        proposals[p] = (struct proposal){proposed[p], rows + p * count, p, rint((sum - before) / unit)};
    }
    qsort(proposals, total, sizeof *proposals, compare_proposals);
    for (int round = 0; round < ORDERED; round++) {
        double last = before;
        for (long i = 0; i < count; i++)
            reached[i] = COVERED / (nearest[i] + COVERED);
        for (long p = 0; p < total; p++) {
            const double sum = NAME(larger)(count, reached, proposals[p].row, 1, 0);
            proposals[p].place = p;
            proposals[p].added = rint((sum - last) / unit);
            last = sum;
        }
        qsort(proposals, total, sizeof *proposals, compare_proposals);
    }
}

/* Pivots (M) of a randomly pivoted Cholesky decomposition of the affinities between points (D, S), with S a multiple of
 * LINE. Scratch holds norms, residuals, squared distances from the nearest pivot, two rows of odds, a row of what is
 * covered, the sums of blocks of odds, the columns (M, S), and rows for the proposals. */
static TARGET void NAME(pivots)(const struct pivots *task, const float *points, long *pivots, float *scratch)
{
    const long size = task->size, count = task->count;
    float *norms = scratch, *residual = norms + count, *nearest = residual + count, *odds = nearest + count;
    float *reached = odds + 2 * count, *columns = reached + 2 * count, *rows = columns + task->num_landmarks * count;
    double *blocks = (double *)(reached + count); /* (2, S / LINE) */
    memset(norms, 0, count * sizeof(float));
    for (long k = 0; k < size; k++)
        for (long i = 0; i < count; i++)
            norms[i] += points[k * count + i] * points[k * count + i];
    for (long i = 0; i < count; i++) {
        residual[i] = 1.0f;
        nearest[i] = i < task->used ? UNCOVERED : 0.0f;
    }
    for (long first = 0, width; first < task->num_landmarks; first += width) {
        width = pivot_block(first, task->num_landmarks);
        struct proposal proposals[TRIALS * LARGEST];
        long proposed[TRIALS * LARGEST], *chosen = pivots + first;
        const long half = width * TRIALS / 2;
        NAME(pivot_odds)(task, residual, nearest, odds);
        for (int kind = 0; kind < 2; kind++) {
            const double total = NAME(sum_blocks)(odds + kind * count, count, blocks);
            for (long t = 0; t < half; t++) {
                const double draw = task->draws[first * TRIALS + kind * half + t];
                proposed[kind * half + t] =
                    NAME(drawn)(odds + kind * count, blocks, task->used, count, (t + draw) / half * total);
            }
        }
        NAME(propose)(task, points, norms, proposed, 2 * half, nearest, reached, rows, proposals);
        for (long p = 0; p < width; p++)
            chosen[p] = proposals[p].point;
        if (first + width == task->num_landmarks)
            return;
        for (long p = 0; p < width; p += TRIALS) { /* again, with rows at the end that are not used */
            for (long t = 0; t < TRIALS; t++)
                proposed[t] = chosen[p + t < width ? p + t : p];
            NAME(distances)(task, points, norms, proposed, rows + p * count);
        }
        for (long p = 0; p < width; p++) {
            const float *apart = rows + p * count;
            float *column = columns + (first + p) * count;
            for (long i = 0; i < count; i += LANES)
                *(FLOATS *)(column + i) = NAME(exp2)(
                    NAME(clamp)(-*(const FLOATS *)(apart + i), -60.0f, 0.0f) * 1.4426950408889634f);
            NAME(accumulate)(columns + chosen[p], count, columns, first + p, count, -1.0f, column);
            const float scale = 1.0f / sqrtf(column[chosen[p]] + task->captured);
            for (long i = 0; i < count; i++) {
                column[i] *= scale;
                residual[i] -= column[i] * column[i];
                nearest[i] = apart[i] < nearest[i] ? apart[i] : nearest[i];
            }
            nearest[chosen[p]] = 0.0f;
        }
    }
}
