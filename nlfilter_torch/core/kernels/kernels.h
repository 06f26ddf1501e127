/* The kernels, included once per instruction set with these macros defined:
 *
 *   NAME(x)   x with the suffix of the instruction set,
 *   TARGET    the function attribute that enables the instruction set,
 *   LANES     floats per register,
 *   ROWS      rows of a product computed together,
 *   VECTORS   registers of pixels processed together; ROWS * VECTORS sums stay in registers,
 *   STREAM    non-temporal (if available) store of a register to an address aligned to its size,
 *   FENCE     completes non-temporal stores.
 *
 * Pixels lie along the lanes, so sums over landmarks or patch positions need no shuffles. */

typedef float NAME(floats) __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef int NAME(ints) __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
#define FLOATS NAME(floats)
#define INTS NAME(ints)
#define PIXELS (LANES * VECTORS) /* in a tile of affinities */
#define INLINE static inline TARGET __attribute__((always_inline))

/* The elements of a register in another order. */
#ifdef __clang__ /* compiles the loop to a shuffle */
INLINE FLOATS NAME(shuffle)(FLOATS x, INTS order)
{
    FLOATS shuffled;
    for (int k = 0; k < LANES; k++)
        shuffled[k] = x[order[k]];
    return shuffled;
}
#define SHUFFLE NAME(shuffle)
#else
#define SHUFFLE __builtin_shuffle
#endif

/* 2^x to 1e-7 for -126 < x <= 0, and NaN for NaN. The polynomial is the minimax one on [-1/2, 1/2]. */
INLINE FLOATS NAME(exp2)(FLOATS x)
{
    const float shift = 12582912.0f; /* 1.5 * 2^23: adding it puts the nearest integer in the lowest bits */
    FLOATS shifted = x + shift, part = x - (shifted - shift);
    FLOATS value = part * 0.0001534581242594868f + 0.0013399930903688073f;
    value = value * part + 0.009618489071726799f;
    value = value * part + 0.05550328642129898f;
    value = value * part + 0.24022646248340607f;
    value = value * part + 0.6931471824645996f;
    value = value * part + 1.0f;
    return value * (FLOATS)(((INTS)shifted << 23) + (127 << 23));
}

/* x limited to [least, most]; NaN stays NaN. */
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

/* out (count, PIXELS), padded to whole blocks = a packed matrix (count, depth) times a tile (depth, PIXELS). */
INLINE void NAME(apply)(const float *matrix, long count, const float *tile, long depth, float *out)
{
    for (long m = 0; m < count; m += ROWS) {
        FLOATS sums[ROWS][VECTORS];
        NAME(multiply)(matrix + m * depth, tile, depth, sums);
        for (int r = 0; r < ROWS; r++)
            for (int v = 0; v < VECTORS; v++)
                *(FLOATS *)(out + (m + r) * PIXELS + v * LANES) = sums[r][v];
    }
}

/* Per-lane sums of products of ROWS rows of left and VECTORS rows of right, over `tiles` tiles of `length` pixels whose
 * rows are `stride` apart. */
INLINE void NAME(correlate)(const float *left, long left_step, const float *right, long right_step, long tiles,
                            long stride, long length, FLOATS sums[ROWS][VECTORS])
{
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
        for (int v = 0; v < VECTORS; v++)
            sums[r][v] = (FLOATS){0};
    for (long t = 0; t < tiles; t++, left += left_step, right += right_step)
        for (long i = 0; i < length; i += LANES) {
            FLOATS pixels[VECTORS];
#pragma GCC unroll 8
            for (int v = 0; v < VECTORS; v++)
                pixels[v] = *(const FLOATS *)(right + v * stride + i);
#pragma GCC unroll 8
            for (int r = 0; r < ROWS; r++) {
                const FLOATS row = *(const FLOATS *)(left + r * stride + i);
#pragma GCC unroll 8
                for (int v = 0; v < VECTORS; v++)
                    sums[r][v] += row * pixels[v];
            }
        }
}

INLINE float NAME(total)(FLOATS x)
{
    INTS lanes;
    for (int k = 0; k < LANES; k++)
        lanes[k] = k;
#pragma GCC unroll 4
    for (int distance = LANES / 2; distance; distance /= 2)
        x += SHUFFLE(x, lanes ^ distance);
    return x[0];
}

/* PIXELS elements of source. If only `width` of them are in the image, a copy in `edge` padded with `fill`. */
INLINE const float *NAME(fetch)(const float *source, long width, float fill, float *edge)
{
    if (width == PIXELS)
        return source;
    for (long i = 0; i < PIXELS; i++)
        edge[i] = i < width ? source[i] : fill;
    return edge;
}

#include "columns.h"
#include "backward.h"
#include "balancing.h"
#include "convolution.h"
#include "grams.h"
#include "landmarks.h"
#include "lattice.h"
#include "stencil.h"
#include "tall_skinny.h"

#undef FLOATS
#undef INTS
#undef PIXELS
#undef INLINE
#undef SHUFFLE
#undef DOUBLES
#undef BLOCK
#undef PIVOTS
