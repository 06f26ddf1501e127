/* Columns of the Nystrom factor, their derivatives, its products, and landmarks, in single precision on processors of
 * the x86-64 kind.
 *
 * The same mathematics as in the files of Python that each part names. What they do with several passes over blocks of
 * memory happens here in the registers: distances, exponentials, whitening by a matrix of which the empty triangle is
 * skipped, norms.
 * Products with a few rows read the factor once, as fast as memory allows.
 *
 * Work is divided into pieces of the image. What is written for each pixel does not depend on the number of threads;
 * sums over pixels are added in float64, for each piece and then in the order of these. Functions return 0, or -1 where
 * memory is short. */

#include <math.h>

#include "tasks.h"

#define NAME(x) x##_avx512
#define TARGET __attribute__((target("avx512f")))
#define LANES 16
#define ROWS 6
#define VECTORS 4
#define STREAM(address, value) __builtin_ia32_movntps512(address, value)
#include "kernels.h"
#undef NAME
#undef TARGET
#undef LANES
#undef ROWS
#undef VECTORS
#undef STREAM

#define NAME(x) x##_avx2
#define TARGET __attribute__((target("avx2,fma")))
#define LANES 8
#define ROWS 3
#define VECTORS 4
#define STREAM(address, value) __builtin_ia32_movntps256(address, value)
#include "kernels.h"

const struct set SETS[] = {
    {0},
    {3, columns_avx2, backward_avx2, spread_avx2, gather_avx2, sweep_avx2, grams_avx2, assign_avx2, pivots_avx2},
    {6, columns_avx512, backward_avx512, spread_avx512, gather_avx512, sweep_avx512, grams_avx512, assign_avx512,
     pivots_avx512},
};

/* The best instruction set that this processor has: 2 for AVX-512, 1 for AVX2 with FMA, 0 for neither. */
int nlfilter_level(void)
{
    if (__builtin_cpu_supports("avx512f"))
        return 2;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}
