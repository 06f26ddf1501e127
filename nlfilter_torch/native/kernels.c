/* Columns of the Nystrom factor, and its products with a few rows, in single precision on processors of the x86-64 kind.
 *
 * The same mathematics as in nystrom.py and thin.py. What they do with several passes over blocks of memory happens
 * here in the registers: distances, exponentials, whitening by a matrix of which the empty triangle is skipped, norms.
 * Products with a few rows read the factor once, as fast as memory allows.
 *
 * Work is divided into pieces of the image. What is written for each pixel does not depend on the number of threads; sums
 * over pixels are added in float64, for each thread and then in the order of these. Functions return 0, or -1 where
 * memory is short. */

#include <math.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define CHUNK 33024  /* pixels that a thread takes at a time, at most: memory likes long pieces of each row */
#define LINE 64      /* a piece is a multiple of so many: a tile, and more than a line of the cache */
#define NEAR 196608  /* numbers of the factor that stay in the second cache */
#define MOST_ROWS 6
#define MOST_PIXELS 64
#define MOST_THREADS 256

static long padded(long count, long step) { return (count + step - 1) / step * step; }

/* U = whitening exp2(landmarks (x, 1, |x|^2)), x = features - centre. */
struct columns {
    const float *features, *centre; /* (D, N), (D) */
    float *factor, *norms;          /* (M, N), (N): |u|^2 before it is limited */
    long features_stride, factor_stride, size, marks;
    float floor; /* of the exponents */
    int limited; /* columns longer than 1 are shortened */
    /* Matrices in blocks of ROWS rows, each stored by columns up to the last that is not zero. */
    const float *landmarks, *whitening;
    const long *depths; /* columns of each block of the whitening */
};

struct thin {
    const float *factor; /* (M, N) */
    long factor_stride, marks, count;
    const float *rows, *images; /* (R, M), (R, N) */
    float *out;                 /* (R, N) */
    long images_stride, out_stride;
    const float *scaling;  /* d, (N), or none */
    const float *diagonal; /* c, (N) */
    float least, most;     /* of half of u . t, and of d */
};

struct grams {
    const float *factor, *scaling, *remainder; /* (M, N), (N), (N) */
    long factor_stride, marks, count;
    long rows, step; /* of a tile of F: with rows of zeros below it, and so many pixels that it stays in the cache */
};

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

static const struct {
    long rows;
    void (*columns)(const struct columns *, long, long, float *);
    void (*spread)(const struct thin *, long, long);
    void (*gather)(const struct thin *, long, long, double *);
    void (*sweep)(const struct thin *, long, long, double *);
    void (*grams)(const struct grams *, long, long, float *, double *);
} SETS[] = {
    {0},
    {3, columns_avx2, spread_avx2, gather_avx2, sweep_avx2, grams_avx2},
    {6, columns_avx512, spread_avx512, gather_avx512, sweep_avx512, grams_avx512},
};

/* The best instruction set that this processor has: 2 for AVX-512, 1 for AVX2 with FMA, 0 for neither. */
int nlfilter_level(void)
{
    if (__builtin_cpu_supports("avx512f"))
        return 2;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}

/* Work on all pixels, piece by piece: whichever thread is free takes the next. */
struct work {
    void (*run)(struct work *, long piece, long first, long last);
    const void *task;
    int level;
    long pixels, length; /* of a piece */
    double *totals;      /* of each piece, where there is something to add up */
    atomic_long next;
    atomic_int failed;
};

static void labour(void *argument)
{
    struct work *work = argument;
    for (;;) {
        const long piece = atomic_fetch_add(&work->next, 1), first = piece * work->length, last = first + work->length;
        if (first >= work->pixels)
            return;
        work->run(work, piece, first, last < work->pixels ? last : work->pixels);
    }
}

/* OpenMP's way to run a function on its threads, once it is known where: torch waits for work with the same threads,
 * awake for a while, so that others would find no free core. */
static void (*parallel)(void (*)(void *), void *, unsigned, unsigned);

void nlfilter_share_threads(void *gomp_parallel) { parallel = gomp_parallel; }

static void *help(void *work)
{
    labour(work);
    return NULL;
}

static int start(struct work *work, int threads)
{
    pthread_t helpers[MOST_THREADS];
    const long pieces = padded(work->pixels, work->length) / work->length;
    int started = 0;
    if (parallel && threads > 1 && pieces > 1) {
        parallel(labour, work, threads, 0);
        return work->failed ? -1 : 0;
    }
    while (started < threads - 1 && started < pieces - 1 && started < MOST_THREADS)
        if (pthread_create(&helpers[started++], NULL, help, work)) {
            started--; /* no more threads to be had: those that there are do it */
            break;
        }
    labour(work);
    for (int i = 0; i < started; i++)
        pthread_join(helpers[i], NULL);
    return work->failed ? -1 : 0;
}

/* Four pieces for each thread, since one may be slower than another, or as many as memory likes. */
static int divide(struct work *work, int threads, long most)
{
    const long length = padded((work->pixels + 4 * threads - 1) / (4 * threads), LINE);
    work->length = length < most ? length : most;
    return start(work, threads);
}

/* Run work that adds up `sums` numbers, and add those of the pieces in their order, so that runs agree. */
static int add_up(struct work *work, int threads, long sums, double *out)
{
    const long pieces = 4 * threads;
    work->totals = calloc(pieces * sums, sizeof(double));
    int status = work->totals ? divide(work, threads, work->pixels) : -1;
    memset(out, 0, sums * sizeof(double));
    for (long i = 0; !status && i < pieces * sums; i++)
        out[i % sums] += work->totals[i];
    free(work->totals);
    return status;
}

/* Rows of a matrix (count, depth) in blocks of `rows`, by columns; rows past the last are zero. */
static float *pack(const float *matrix, long count, long depth, long rows, long *depths)
{
    float *packed = malloc(padded(count, rows) * depth * sizeof(float)), *target = packed;
    if (!packed)
        return NULL;
    for (long m = 0, block = 0; m < count; m += rows, block++) {
        long used = 0;
        for (long r = m; r < m + rows && r < count; r++)
            for (long k = used; k < depth; k++)
                if (matrix[r * depth + k] != 0.0f)
                    used = k + 1;
        if (!depths)
            used = depth;
        else
            depths[block] = used;
        for (long k = 0; k < used; k++)
            for (long r = 0; r < rows; r++)
                *target++ = m + r < count ? matrix[(m + r) * depth + k] : 0.0f;
    }
    return packed;
}

static void run_columns(struct work *work, long piece, long first, long last)
{
    const struct columns *task = work->task;
    size_t floats = (task->size + 3 + padded(task->marks, MOST_ROWS)) * MOST_PIXELS;
    float *scratch = aligned_alloc(64, floats * sizeof(float));
    (void)piece;
    if (scratch)
        SETS[work->level].columns(task, first, last, scratch);
    else
        work->failed = 1;
    free(scratch);
}

int nlfilter_columns(int level, int threads, long pixels, long size, long marks, const float *features,
                     long features_stride, const float *centre, const float *landmarks, const float *whitening,
                     float floor, int limited, float *factor, long factor_stride, float *norms)
{
    const long rows = SETS[level].rows;
    struct columns task = {features, centre, factor, norms, features_stride, factor_stride, size, marks, floor, limited,
                           NULL, NULL, NULL};
    long *depths = malloc(padded(marks, rows) / rows * sizeof(long));
    float *packed = pack(landmarks, marks, size + 2, rows, NULL);
    float *whiteners = depths ? pack(whitening, marks, marks, rows, depths) : NULL;
    struct work work = {run_columns, &task, level, pixels, 0, NULL, 0, !packed || !whiteners};
    task.landmarks = packed, task.whitening = whiteners, task.depths = depths;
    int status = work.failed ? -1 : divide(&work, threads, CHUNK);
    free(depths);
    free(packed);
    free(whiteners);
    return status;
}

static void run_spread(struct work *work, long piece, long first, long last)
{
    (void)piece;
    SETS[work->level].spread(work->task, first, last);
}

int nlfilter_spread(int level, int threads, long pixels, long marks, long count, const float *rows, const float *factor,
                    long factor_stride, const float *scaling, float *out, long out_stride)
{
    struct thin task = {factor, factor_stride, marks, count, rows, NULL, out, 0, out_stride, scaling, NULL, 0, 0};
    struct work work = {run_spread, &task, level, pixels, 0, NULL, 0, 0};
    return divide(&work, threads, CHUNK);
}

static void run_gather(struct work *work, long piece, long first, long last)
{
    const struct thin *task = work->task;
    SETS[work->level].gather(task, first, last, work->totals + piece * task->count * task->marks);
}

int nlfilter_gather(int level, int threads, long pixels, long marks, long count, const float *images,
                    long images_stride, const float *factor, long factor_stride, double *out)
{
    struct thin task = {factor, factor_stride, marks, count, NULL, images, NULL, images_stride, 0, NULL, NULL, 0, 0};
    struct work work = {run_gather, &task, level, pixels, 0, NULL, 0, 0};
    return add_up(&work, threads, count * marks, out);
}

static void run_sweep(struct work *work, long piece, long first, long last)
{
    const struct thin *task = work->task;
    SETS[work->level].sweep(task, first, last, work->totals + piece * task->marks);
}

int nlfilter_sweep(int level, int threads, long pixels, long marks, const float *half, const float *factor,
                   long factor_stride, const float *diagonal, float least, float most, float *scaling, double *out)
{
    struct thin task = {factor, factor_stride, marks, 1, half, scaling, scaling, 0, 0, NULL, diagonal, least, most};
    struct work work = {run_sweep, &task, level, pixels, 0, NULL, 0, 0};
    return add_up(&work, threads, marks, out);
}

static void run_grams(struct work *work, long piece, long first, long last)
{
    const struct grams *task = work->task;
    size_t floats = (1 + MOST_ROWS + task->rows) * task->step;
    float *scratch = aligned_alloc(64, floats * sizeof(float));
    if (scratch)
        SETS[work->level].grams(task, first, last, scratch, work->totals + piece * task->count * task->marks * task->marks);
    else
        work->failed = 1;
    free(scratch);
}

int nlfilter_grams(int level, int threads, long pixels, long marks, long count, const float *factor, long factor_stride,
                   const float *scaling, const float *remainder, double *out)
{
    const long rows = padded(marks, 12), fitting = NEAR / rows / 64 * 64; /* rows: whole blocks both ways */
    struct grams task = {factor, scaling, remainder, factor_stride, marks, count, rows, 0};
    task.step = fitting < 64 ? 64 : fitting > 1024 ? 1024 : fitting;
    struct work work = {run_grams, &task, level, pixels, 0, NULL, 0, 0};
    int status = add_up(&work, threads, count * marks * marks, out);
    for (long k = 0; k < count; k++, out += marks * marks)
        for (long m = 0; m < marks; m++)
            for (long n = m + 1; n < marks; n++)
                out[m * marks + n] = out[n * marks + m];
    return status;
}
