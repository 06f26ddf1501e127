/* Functions that Python calls, declared here alone: C checks the definitions against this file, and
 * tests/core/kernels/test_library.py the argument types that ctypes converts to.
 *
 * `level` is the instruction set, an index of SETS; `threads` the number of threads; B images have N = `pixels` pixels.
 * The functions that take these return 0 on success and -1 if memory cannot be allocated. */

#pragma once

/* Of the choice of pivots; as in clusters.py. */
#define TRIALS 6          /* proposals for each pivot */
#define FIRST 6           /* pivots of the first block; each other block has twice as many as all before it */
#define LARGEST 48        /* pivots of the largest block */
#define ORDERED 2         /* times that proposals are ordered by what they add */
#define COVERED 4.0f      /* squared distance from the nearest pivot at which a point counts as half covered */
#define UNCOVERED 1e16f   /* squared distance before there is a pivot, and the largest that counts */
#define DISTINCT 1e-6f    /* added to squared distances, so that there are probabilities where all points are equal */
#define NEARLY 1e-5       /* proposals that cover more by less than this share of the points are equally good */

/* Of balancing; as in operator/scaling.py. */
#define LARGEST_ROOT 2.0f /* bound of d while t is approximate */
#define GUESSES 3         /* fixed-point steps of the initial guess */
#define SAMPLE_STEPS 3    /* Newton steps on a sample */
#define UNIFORM 0.05      /* fraction of the sample drawn uniformly */
#define MAX_SWEEPS 12
#define RESAMPLED 0.2f    /* a new sample is drawn after a sweep that reduces the error by less */

/* The best instruction set that this processor supports, as an index of SETS; 0 for none. */
int nlfilter_level(void);

/* Run on the threads of an OpenMP library from now on, by its function GOMP_parallel; NULL: on a pool of its own. */
void nlfilter_share_threads(void *gomp_parallel);

/* Columns (B, M, N) of the Nystrom factor; norms (B, N) are written if `limited`. */
int nlfilter_columns(int level, int threads, long pixels, long images, long size, long num_landmarks,
                     const float *features, long features_step, long features_stride, const float *centre,
                     const float *landmarks, const float *inverse_cholesky, float floor, int limited, float *factor,
                     long factor_step, long factor_stride, float *norms);

/* Gradients of the columns' inputs. The gradient of the columns is left right; if `left` is NULL, it is `right`, and
 * `rank` is the number of landmarks. */
int nlfilter_backward(int level, int threads, long pixels, long images, long size, long num_landmarks,
                      const float *features, long features_step, long features_stride, const float *centre,
                      const float *landmarks, const float *inverse_cholesky, float floor, int limited, float *factor,
                      long factor_step, long factor_stride, const float *scale, long rank, const float *left,
                      const float *right, long right_step, long right_stride, const float *diagonal,
                      const float *points, float *moved, double *totals);

/* rows (B, R, M) times the factor and, unless it is NULL, a diagonal scaling (B, N). */
int nlfilter_spread(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                    long factor_step, long factor_stride, long count, const float *rows, const float *scaling,
                    float *out);

/* planes (B, R, N) times the transposed factor. */
int nlfilter_gather(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                    long factor_step, long factor_stride, long count, const float *planes, long planes_step,
                    long planes_stride, double *out);

/* A vector over all pixels and its moment: with `diagonal` the scaling that belongs to `row`, half an estimate of the
 * moment; with `scaling` its product with the row times the factor. The moment is that of the vector times the
 * `weights` (B, N), unless these are NULL. */
int nlfilter_sweep(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                   long factor_step, long factor_stride, const float *row, const float *scaling, const float *diagonal,
                   const float *weights, float most, float *out, double *moment);

/* Gram matrices (B, R, M, M) of the scaled factor, weighted by powers of the remainder. */
int nlfilter_grams(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                   long factor_step, long factor_stride, long count, const float *scaling, const float *remainder,
                   double *out);

/* The scaling (B, N) that balances kernels with a unit diagonal, its moment (B, M), the largest deviation of a row sum
 * (B), an approximate inverse of the Jacobian (B, M, M), and the number of sweeps (B). The first guess is that of the
 * points with the numbers `explored`, or of all if it is NULL; Newton's method runs on `sampled_count` points, or on all
 * if these are more than half of them. */
int nlfilter_balance(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                     long factor_step, long factor_stride, const float *diagonal, const float *weights,
                     const long *explored, long explored_count, long sampled_count, float tolerance, float *scaling,
                     double *moment, float *residual, double *inverse, long *steps);

/* Solutions (B, M) of (I + U diag(weight) U^T) s = right for the factor U, preconditioned by `inverse`, and what is
 * `left` (B) of the squared residual, relative. */
int nlfilter_conjugate(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                       long factor_step, long factor_stride, const float *weight, const double *right,
                       const double *inverse, long most_steps, double solved, double *solution, double *left);

/* Lloyd's iteration of k-means: the nearest centre (B, S) of each point. */
int nlfilter_lloyd(int level, int threads, long images, long size, long count, long num_landmarks, long iterations,
                   float margin, const float *points, const float *start, int *nearest);

/* Pivots (B, M) of randomly pivoted Cholesky decompositions, in blocks of the best of TRIALS proposals for each. */
int nlfilter_pivots(int level, int threads, long images, long size, long count, long num_landmarks, float captured,
                    const float *points, const float *draws, long *pivots);

/* Convolution with 3x3 weights of features that pass through a leaky rectifier. */
int nlfilter_convolution(int level, int threads, long images, long height, long width, long channels, long outputs,
                         long padded_outputs, long dilation, float slope, const float *features, const float *weights,
                         const float *bias, const float *added, float *out);

/* Values (B, 3, N) at colours (B, 3, N), interpolated in lattices (B, n, n, n, 4) whose fourth value is 0. */
int nlfilter_lattice(int level, int threads, long pixels, long images, long nodes, const float *colours,
                     long colours_step, long colours_stride, const float *lattice, long lattice_step, float *out);

/* Solutions (B, C, H, W) of linear systems of pixels and their eight neighbours. */
int nlfilter_stencil(int level, int threads, long images, long height, long width, long sides, const double *stencil,
                     const double *right, double *out);
