/* What every instruction set computes: included once for each of them, with
 *
 *   NAME(x)   the name x has in this instance,
 *   TARGET    the attribute that allows the compiler its instructions,
 *   LANES     floats in a register,
 *   ROWS      rows of a product that are formed together,
 *   VECTORS   registers of pixels that are formed together; ROWS * VECTORS sums stay in registers,
 *   STREAM    how to store a register so that memory is not read before, at an address that is a multiple of its size.
 *
 * Pixels lie along the lanes, so that a sum over landmarks or patch positions needs no shuffling. */

typedef float NAME(floats) __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int NAME(ints) __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
#define FLOATS NAME(floats)
#define INTS NAME(ints)
#define PIXELS (LANES * VECTORS) /* in a tile of affinities */
#define INLINE static inline TARGET __attribute__((always_inline))

/* 2^x to 1e-7 for -126 < x <= 0, and NaN for NaN. The polynomial is the minimax one on [-1/2, 1/2]. */
INLINE FLOATS NAME(exp2)(FLOATS x)
{
    const float shift = 12582912.0f; /* 1.5 * 2^23: added to x, it leaves the nearest integer in the lowest bits */
    FLOATS shifted = x + shift, part = x - (shifted - shift);
    FLOATS value = part * 0.0001534581242594868f + 0.0013399930903688073f;
    value = value * part + 0.009618489071726799f;
    value = value * part + 0.05550328642129898f;
    value = value * part + 0.24022646248340607f;
    value = value * part + 0.6931471824645996f;
    value = value * part + 1.0f;
    return value * (FLOATS)(((INTS)shifted << 23) + (127 << 23));
}

/* x between the two limits; NaN stays NaN. */
INLINE FLOATS NAME(clamp)(FLOATS x, float least, float most)
{
    INTS above = x > most, below = x < least;
    INTS bounds = ((INTS)((FLOATS){0} + most) & above) | ((INTS)((FLOATS){0} + least) & below);
    return (FLOATS)(((INTS)x & ~(above | below)) | bounds);
}

/* sums = packed rows (depth, ROWS) times a tile (depth, PIXELS). */
INLINE void NAME(multiply)(const float *rows, const float *tile, long depth, FLOATS sums[ROWS][VECTORS])
{
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++)
            sums[r][v] = (FLOATS){0};
    for (long k = 0; k < depth; k++, rows += ROWS, tile += PIXELS) {
        FLOATS pixels[VECTORS];
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++)
            pixels[v] = *(const FLOATS *)(tile + v * LANES);
#pragma GCC unroll 8
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
            for (int v = 0; v < VECTORS; v++)
                sums[r][v] += rows[r] * pixels[v];
    }
}

/* The columns of the factor for the pixels from first to last: affinities, whitened, of norm at most 1 if asked. */
static TARGET void NAME(columns)(const struct columns *task, long first, long last, float *scratch)
{
    const long size = task->size, marks = task->marks;
    float *features = scratch, *affinities = features + (size + 2) * PIXELS;
    float *edge = affinities + padded(marks, ROWS) * PIXELS; /* a row of a tile that the image ends in */
    for (long start = first; start < last; start += PIXELS) {
        const long width = last - start < PIXELS ? last - start : PIXELS;
        FLOATS norm[VECTORS];
        for (int v = 0; v < VECTORS; v++)
            norm[v] = (FLOATS){0};
        for (long k = 0; k < size; k++) {
            const float *source = task->features + k * task->features_stride + start;
            if (width < PIXELS) {
                for (long i = 0; i < PIXELS; i++)
                    edge[i] = i < width ? source[i] : task->centre[k];
                source = edge;
            }
            for (int v = 0; v < VECTORS; v++) {
                FLOATS centred = *(const FLOATS *)(source + v * LANES) - task->centre[k];
                *(FLOATS *)(features + k * PIXELS + v * LANES) = centred;
                norm[v] += centred * centred;
            }
        }
        for (int v = 0; v < VECTORS; v++) {
            *(FLOATS *)(features + size * PIXELS + v * LANES) = (FLOATS){0} + 1.0f;
            *(FLOATS *)(features + (size + 1) * PIXELS + v * LANES) = norm[v];
            norm[v] = (FLOATS){0};
        }
        for (long m = 0; m < marks; m += ROWS) {
            FLOATS exponents[ROWS][VECTORS];
            NAME(multiply)(task->landmarks + m * (size + 2), features, size + 2, exponents);
            for (int r = 0; r < ROWS; r++)
                for (int v = 0; v < VECTORS; v++)
                    *(FLOATS *)(affinities + (m + r) * PIXELS + v * LANES) =
                        NAME(exp2)(NAME(clamp)(exponents[r][v], task->floor, 0.0f));
        }
        const float *rows = task->whitening;
        for (long m = 0, block = 0; m < marks; m += ROWS, block++) {
            FLOATS whitened[ROWS][VECTORS];
            NAME(multiply)(rows, affinities, task->depths[block], whitened);
            rows += task->depths[block] * ROWS;
            for (long r = 0; r < ROWS && m + r < marks; r++) {
                float *target = task->factor + (m + r) * task->factor_stride + start;
                float *found = width < PIXELS ? edge : target;
                const int streamed = (uintptr_t)found % sizeof(FLOATS) == 0;
                for (int v = 0; v < VECTORS; v++) {
                    norm[v] += whitened[r][v] * whitened[r][v];
                    if (streamed)
                        STREAM(found + v * LANES, whitened[r][v]);
                    else
                        *(FLOATS *)(found + v * LANES) = whitened[r][v];
                }
                if (width < PIXELS)
                    memcpy(target, edge, width * sizeof(float));
            }
        }
        for (int v = 0; v < VECTORS; v++)
            *(FLOATS *)(edge + v * LANES) = norm[v];
        memcpy(task->norms + start, edge, width * sizeof(float));
        for (long i = 0; task->limited && i < width; i++)
            if (edge[i] > 1.0f) { /* by rounding alone, and seldom */
                const float scale = 1.0f / sqrtf(edge[i]);
                for (long m = 0; m < marks; m++)
                    task->factor[m * task->factor_stride + start + i] *= scale;
            }
    }
    __builtin_ia32_sfence(); /* what was streamed is there before anyone is told so */
}

/* Where the next rows of the factor begin; past the last one it is that once more. Several at a time keep memory busy. */
INLINE void NAME(adjacent)(const struct thin *task, long row, long start, int count, const float **found)
{
    for (long k = 0; k < count; k++)
        found[k] = task->factor + (row + k < task->marks ? row + k : task->marks - 1) * task->factor_stride + start;
}

/* out = rows (R, M) times the columns of the factor from first to last, not more than a chunk of them, times scaling. */
static TARGET void NAME(spread)(const struct thin *task, long first, long last)
{
    const long marks = task->marks, width = last - first, whole = width / LANES * LANES;
    for (long r = 0; r < task->count; r++)
        memset(task->out + r * task->out_stride + first, 0, width * sizeof(float));
    for (long m = 0; m < marks; m += 8) {
        const float *column[8];
        NAME(adjacent)(task, m, first, 8, column);
        for (long r = 0; r < task->count; r++) {
            float *sums = task->out + r * task->out_stride + first, weight[8];
            for (long k = 0; k < 8; k++)
                weight[k] = m + k < marks ? task->rows[r * marks + m + k] : 0.0f;
            for (long i = 0; i < whole; i += LANES) {
                FLOATS sum = *(const FLOATS *)(sums + i);
#pragma GCC unroll 8
                for (int k = 0; k < 8; k++)
                    sum += weight[k] * *(const FLOATS *)(column[k] + i);
                *(FLOATS *)(sums + i) = sum;
            }
            for (long i = whole; i < width; i++)
                for (long k = 0; k < 8; k++)
                    sums[i] += weight[k] * column[k][i];
        }
    }
    for (long r = 0; task->scaling && r < task->count; r++)
        for (long i = first; i < last; i++)
            task->out[r * task->out_stride + i] *= task->scaling[i];
}

/* totals (R, M) += images (R, N) times the factor's transpose, over the pixels from first to last. */
static TARGET void NAME(gather)(const struct thin *task, long first, long last, double *totals)
{
    const long marks = task->marks;
    for (long start = first; start < last; start += CHUNK) {
        const long width = last - start < CHUNK ? last - start : CHUNK;
        const long whole = width / (2 * LANES) * (2 * LANES);
        for (long m = 0; m < marks; m += 4) {
            const float *column[4];
            NAME(adjacent)(task, m, start, 4, column);
            for (long r = 0; r < task->count; r++) {
                const float *image = task->images + r * task->images_stride + start;
                FLOATS sums[4][2] = {{{0}}};
                for (long i = 0; i < whole; i += 2 * LANES) {
                    FLOATS left = *(const FLOATS *)(image + i), right = *(const FLOATS *)(image + i + LANES);
#pragma GCC unroll 4
                    for (int k = 0; k < 4; k++) {
                        sums[k][0] += left * *(const FLOATS *)(column[k] + i);
                        sums[k][1] += right * *(const FLOATS *)(column[k] + i + LANES);
                    }
                }
                for (long k = 0; k < 4 && m + k < marks; k++) {
                    FLOATS lanes = sums[k][0] + sums[k][1];
                    float sum = 0.0f;
                    for (int lane = 0; lane < LANES; lane++)
                        sum += lanes[lane];
                    for (long i = whole; i < width; i++)
                        sum += image[i] * column[k][i];
                    totals[r * marks + m + k] += sum;
                }
            }
        }
    }
}

/* out = the root d of d (u . 2 rows + c d) = 1 for the pixels from first to last, and totals += their moment, factor d.
 * So few pixels at a time that their columns are still near when the moment is formed. */
static TARGET void NAME(sweep)(const struct thin *task, long first, long last, double *totals)
{
    const long most = NEAR / task->marks / 64 * 64, step = most < 256 ? 256 : most;
    for (long start = first; start < last; start += step) {
        const long end = last - start < step ? last : start + step;
        NAME(spread)(task, start, end);
        for (long i = start; i < end; i++) {
            const float half = task->out[i] < task->least ? task->least : task->out[i];
            const float root = 1.0f / (sqrtf(half * half + task->diagonal[i]) + half);
            task->out[i] = root > task->most ? task->most : root;
        }
        NAME(gather)(task, start, end, totals);
    }
}

INLINE float NAME(total)(FLOATS x)
{
    INTS lanes;
    for (int k = 0; k < LANES; k++)
        lanes[k] = k;
#pragma GCC unroll 4
    for (int distance = LANES / 2; distance; distance /= 2)
        x += __builtin_shuffle(x, lanes ^ distance);
    return x[0];
}

/* totals (J, M, M) += F diag(r^j) F^T over the pixels from first to last, F = factor diag(d); lower triangles only. */
static TARGET void NAME(grams)(const struct grams *task, long first, long last, float *scratch, double *totals)
{
    const long marks = task->marks, step = task->step;
    float *weight = scratch, *weighted = weight + step, *scaled = weighted + ROWS * step;
    memset(scaled + marks * step, 0, (task->rows - marks) * step * sizeof(float));
    for (long start = first; start < last; start += step) {
        const long width = last - start < step ? last - start : step, whole = padded(width, LANES);
        for (long m = 0; m < marks; m++) {
            const float *column = task->factor + m * task->factor_stride + start;
            for (long i = 0; i < width; i++)
                scaled[m * step + i] = column[i] * task->scaling[start + i];
            for (long i = width; i < whole; i++)
                scaled[m * step + i] = 0.0f;
        }
        for (long i = 0; i < step; i++)
            weight[i] = 1.0f;
        for (long j = 0; j < task->count; j++) {
            for (long i = 0; j && i < width; i++)
                weight[i] *= task->remainder[start + i];
            for (long m = 0; m < marks; m += ROWS) {
                const float *left = scaled + m * step;
                if (j) {
                    for (long r = 0; r < ROWS; r++)
                        for (long i = 0; i < whole; i++)
                            weighted[r * step + i] = left[r * step + i] * weight[i];
                    left = weighted;
                }
                for (long n = 0; n < m + ROWS && n < marks; n += VECTORS) {
                    const float *right = scaled + n * step;
                    FLOATS sums[ROWS][VECTORS];
#pragma GCC unroll 8
                    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            sums[r][v] = (FLOATS){0};
                    for (long i = 0; i < whole; i += LANES) {
                        FLOATS pixels[VECTORS];
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            pixels[v] = *(const FLOATS *)(right + v * step + i);
#pragma GCC unroll 8
                        for (int r = 0; r < ROWS; r++) {
                            const FLOATS row = *(const FLOATS *)(left + r * step + i);
#pragma GCC unroll 8
                            for (int v = 0; v < VECTORS; v++)
                                sums[r][v] += row * pixels[v];
                        }
                    }
#pragma GCC unroll 8
                    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
                        for (int v = 0; v < VECTORS; v++)
                            if (m + r < marks && n + v <= m + r)
                                totals[(j * marks + m + r) * marks + n + v] += NAME(total)(sums[r][v]);
                }
            }
        }
    }
}

#undef FLOATS
#undef INTS
#undef PIXELS
#undef INLINE
