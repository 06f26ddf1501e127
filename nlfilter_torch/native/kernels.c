/* Columns of the Nystrom factor, its products, and landmarks, in single precision on processors of the x86-64 kind.
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
    float *factor, *norms;          /* (M, N), (N): |u|^2 before it is limited, if it is */
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
    long images_stride;
    const float *scaling;  /* d, (N), or none */
    const float *diagonal; /* c, (N), or none */
    float least, most;     /* of half of u . t, and of d */
    long factor_step, images_step; /* from one image of a batch to the next; everything else is contiguous */
    long pixels;                   /* N */
};

struct grams {
    const float *factor, *scaling, *remainder; /* (M, N), (N), (N) */
    long factor_stride, marks, count;
    long rows, step; /* of a tile of F: with rows of zeros below it, and so many pixels that it stays in the cache */
};

struct pivots {
    const float *points, *draws; /* (B, D, S), (M) */
    long *pivots;                /* (B, M) */
    long size, used, count, marks; /* S, and S in whole lines */
    float explained;
};

struct lloyd {
    const float *points, *start; /* (B, D, S), (B, D, M) */
    int *nearest;                /* (B, S) */
    long size, count, marks, iterations;
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
    void (*assign)(const struct lloyd *, const float *, const float *, float *, int *, float *);
    void (*pivots)(const struct pivots *, const float *, long *, float *);
} SETS[] = {
    {0},
    {3, columns_avx2, spread_avx2, gather_avx2, sweep_avx2, grams_avx2, assign_avx2, pivots_avx2},
    {6, columns_avx512, spread_avx512, gather_avx512, sweep_avx512, grams_avx512, assign_avx512, pivots_avx512},
};

/* The best instruction set that this processor has: 2 for AVX-512, 1 for AVX2 with FMA, 0 for neither. */
int nlfilter_level(void)
{
    if (__builtin_cpu_supports("avx512f"))
        return 2;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") ? 1 : 0;
}

#include "threads.h"

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

static void run_columns(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    (void)image, (void)piece;
    SETS[work->level].columns(work->task, first, last, scratch);
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
    struct work work = {.run = run_columns, .task = &task, .level = level, .images = 1, .pixels = pixels,
                        .floats = (size + 3 + 2 * padded(marks, rows)) * MOST_PIXELS};
    task.landmarks = packed, task.whitening = whiteners, task.depths = depths;
    int status = packed && whiteners ? divide(&work, threads, CHUNK) : -1;
    free(depths);
    free(packed);
    free(whiteners);
    return status;
}

/* What there is of a batch for one of its images. */
static struct thin part(const struct work *work, long image)
{
    struct thin task = *(const struct thin *)work->task;
    task.factor += image * task.factor_step;
    task.rows = task.rows ? task.rows + image * task.count * task.marks : NULL;
    task.images = task.images ? task.images + image * task.images_step : NULL;
    task.out = task.out ? task.out + image * task.count * task.pixels : NULL;
    task.scaling = task.scaling ? task.scaling + image * task.pixels : NULL;
    task.diagonal = task.diagonal ? task.diagonal + image * task.pixels : NULL;
    return task;
}

static void run_spread(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct thin task = part(work, image);
    (void)piece, (void)scratch;
    SETS[work->level].spread(&task, first, last);
}

int nlfilter_spread(int level, int threads, long pixels, long images, long marks, const float *factor, long factor_step,
                    long factor_stride, long count, const float *rows, const float *scaling, float *out)
{
    struct thin task = {.factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .marks = marks,
                        .count = count, .rows = rows, .scaling = scaling, .out = out, .pixels = pixels};
    struct work work = {.run = run_spread, .task = &task, .level = level, .images = images, .pixels = pixels};
    return divide(&work, threads, CHUNK);
}

static void run_gather(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct thin task = part(work, image);
    (void)scratch;
    SETS[work->level].gather(&task, first, last, work->totals + piece * task.count * task.marks);
}

int nlfilter_gather(int level, int threads, long pixels, long images, long marks, const float *factor, long factor_step,
                    long factor_stride, long count, const float *planes, long planes_step, long planes_stride,
                    double *out)
{
    struct thin task = {.factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .marks = marks,
                        .count = count, .images = planes, .images_step = planes_step, .images_stride = planes_stride,
                        .pixels = pixels};
    struct work work = {.run = run_gather, .task = &task, .level = level, .images = images, .pixels = pixels};
    return add_up(&work, threads, count * marks, out);
}

static void run_sweep(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct thin task = part(work, image);
    (void)scratch;
    SETS[work->level].sweep(&task, first, last, work->totals + piece * task.marks);
}

/* Given a diagonal, what out = d has for a moment where row is half of its guess; else factor diag(scaling) factor^T
 * row, and out is room for what lies between. */
int nlfilter_sweep(int level, int threads, long pixels, long images, long marks, const float *factor, long factor_step,
                   long factor_stride, const float *row, const float *scaling, const float *diagonal, float least,
                   float most, float *out, double *moment)
{
    struct thin task = {.factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .marks = marks,
                        .count = 1, .rows = row, .scaling = scaling, .diagonal = diagonal, .least = least, .most = most,
                        .images = out, .images_step = pixels, .out = out, .pixels = pixels};
    struct work work = {.run = run_sweep, .task = &task, .level = level, .images = images, .pixels = pixels};
    return add_up(&work, threads, marks, moment);
}

static void run_grams(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct grams *task = work->task;
    (void)image;
    SETS[work->level].grams(task, first, last, scratch, work->totals + piece * task->count * task->marks * task->marks);
}

int nlfilter_grams(int level, int threads, long pixels, long marks, long count, const float *factor, long factor_stride,
                   const float *scaling, const float *remainder, double *out)
{
    const long rows = padded(marks, 12), fitting = NEAR / rows / 64 * 64; /* rows: whole blocks both ways */
    struct grams task = {factor, scaling, remainder, factor_stride, marks, count, rows, 0};
    task.step = fitting < 64 ? 64 : fitting > 1024 ? 1024 : fitting;
    struct work work = {.run = run_grams, .task = &task, .level = level, .images = 1, .pixels = pixels,
                        .floats = (1 + MOST_ROWS + rows) * task.step};
    int status = add_up(&work, threads, count * marks * marks, out);
    for (long k = 0; k < count; k++, out += marks * marks)
        for (long m = 0; m < marks; m++)
            for (long n = m + 1; n < marks; n++)
                out[m * marks + n] = out[n * marks + m];
    return status;
}

/* Lloyd's iteration on one image; scratch holds packed centres, sums with sizes, and a tile. */
static void cluster(const struct lloyd *task, int level, long image, float *scratch)
{
    const long size = task->size, count = task->count, marks = task->marks, rows = SETS[level].rows;
    const float *points = task->points + image * size * count, *start = task->start + image * size * marks;
    int *nearest = task->nearest + image * count;
    float *centres = scratch, *sums = centres + padded(marks, rows) * (size + 1), *tile = sums + marks * (size + 1);
    memset(sums, 0, marks * (size + 1) * sizeof(float));
    for (long step = 0; step <= task->iterations; step++) {
        for (long m = 0; m < padded(marks, rows); m++) {
            float *target = centres + m / rows * rows * (size + 1) + m % rows, length = 0.0f;
            const float *sum = sums + m * (size + 1);
            for (long k = 0; k < size; k++) { /* a centre without points stays where it began */
                const float value = m >= marks ? 0.0f : sum[size] ? sum[k] / sum[size] : start[k * marks + m];
                target[k * rows] = value;
                length += value * value;
            }
            target[size * rows] = m < marks ? -0.5f * length : -INFINITY;
        }
        memset(sums, 0, marks * (size + 1) * sizeof(float));
        SETS[level].assign(task, points, centres, tile, nearest, sums);
    }
}

static void run_lloyd(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    (void)piece, (void)first, (void)last;
    cluster(work->task, work->level, image, scratch);
}

int nlfilter_lloyd(int level, int threads, long images, long size, long count, long marks, long iterations,
                   const float *points, const float *start, int *nearest)
{
    struct lloyd task = {points, start, nearest, size, count, marks, iterations};
    struct work work = {.run = run_lloyd, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .each = 1, .floats = (size + 1) * (2 * padded(marks, MOST_ROWS) + MOST_PIXELS)};
    return begin(&work, threads);
}

static void run_pivots(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct pivots *task = work->task;
    float *points = scratch + (task->marks + 2) * task->count; /* with whole lines */
    (void)piece, (void)first, (void)last;
    for (long k = 0; k < task->size; k++) {
        const float *row = task->points + (image * task->size + k) * task->used;
        memcpy(points + k * task->count, row, task->used * sizeof(float));
        memset(points + k * task->count + task->used, 0, (task->count - task->used) * sizeof(float));
    }
    SETS[work->level].pivots(task, points, task->pivots + image * task->marks, scratch);
}

int nlfilter_pivots(int level, int threads, long images, long size, long count, long marks, float explained,
                    const float *points, const float *draws, long *pivots)
{
    const long whole = padded(count, LINE);
    struct pivots task = {points, draws, pivots, size, count, whole, marks, explained};
    struct work work = {.run = run_pivots, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .each = 1, .floats = (marks + 2 + size) * whole};
    return begin(&work, threads);
}
