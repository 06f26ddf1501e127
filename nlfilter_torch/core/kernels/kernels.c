/* Kernels for x86-64 and AArch64: columns of the Nystrom factor and their gradients, products with the factor, Gram
 * matrices, landmarks, convolutions and lattices of colours, in float32; linear systems of pixels and their neighbours,
 * in float64.
 *
 * Each part names the Python file that defines the same computation in torch. Where torch makes several passes over
 * memory, these kernels keep distances, exponentials and norms in registers, and skip the zero triangle of the inverse
 * Cholesky factor. Tall-skinny products read the factor once, at memory bandwidth.
 *
 * Images are divided into pieces. Per-pixel results do not depend on the number of threads. Sums over pixels are
 * accumulated in float64 within each piece, and the sums of the pieces are added in order. Functions return 0 on
 * success and -1 if memory cannot be allocated. */

#include <math.h>
#ifdef __x86_64__
#include <immintrin.h>
#endif

#include "tasks.h"

#ifdef __x86_64__
#define NAME(x) x##_avx512
#define TARGET __attribute__((target("avx512f")))
#define LANES 16
#define ROWS 6
#define VECTORS 4
#define STREAM(address, value) _mm512_stream_ps(address, (__m512)(value))
#define FENCE() _mm_sfence()
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
#define STREAM(address, value) _mm256_stream_ps(address, (__m256)(value))
#include "kernels.h"

const struct set SETS[] = {
    {0},
    {3, columns_avx2, backward_avx2, spread_avx2, gather_avx2, sweep_avx2, grams_avx2, positive_avx2, assign_avx2, pivots_avx2,
     convolution_avx2, lattice_avx2, eliminate_avx2, substitute_avx2},
    {6, columns_avx512, backward_avx512, spread_avx512, gather_avx512, sweep_avx512, grams_avx512, positive_avx512, assign_avx512,
     pivots_avx512, convolution_avx512, lattice_avx512, eliminate_avx512, substitute_avx512},
};

/* The best supported instruction set: 2 for AVX-512, 1 for AVX2 with FMA, 0 for neither. */
int nlfilter_level(void)
{
    if (__builtin_cpu_supports("avx512f"))
        return 2;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}

#elif defined(__aarch64__)
#define NAME(x) x##_neon
#define TARGET
#define LANES 4
#define ROWS 6
#define VECTORS 4
#define STREAM(address, value) (*(FLOATS *)(address) = (value))
#define FENCE()
#include "kernels.h"

const struct set SETS[] = {
    {0},
    {6, columns_neon, backward_neon, spread_neon, gather_neon, sweep_neon, grams_neon, positive_neon, assign_neon, pivots_neon,
     convolution_neon, lattice_neon, eliminate_neon, substitute_neon},
};

/* Every AArch64 processor has NEON. */
int nlfilter_level(void) { return 1; }
#else
#error "the kernels are for x86-64 and AArch64"
#endif
