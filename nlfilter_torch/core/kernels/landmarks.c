/* Choice of landmarks. */

#include <math.h>

#include "tasks.h"

/* Lloyd's iteration on one image. Scratch holds the packed centres, the sums and sizes of the clusters, and a tile. */
static void cluster(const struct lloyd *task, int level, long image, float *scratch)
{
    const long size = task->size, count = task->count, num_landmarks = task->num_landmarks, rows = SETS[level].rows;
    const float *points = task->points + image * size * count, *start = task->start + image * size * num_landmarks;
    int *nearest = task->nearest + image * count;
    float *centres = scratch, *sums = centres + padded(num_landmarks, rows) * (size + 1);
    float *tile = sums + num_landmarks * (size + 1);
    memset(sums, 0, num_landmarks * (size + 1) * sizeof(float));
    for (long step = 0; step <= task->iterations; step++) {
        for (long m = 0; m < padded(num_landmarks, rows); m++) {
            float *target = centres + m / rows * rows * (size + 1) + m % rows, length = 0.0f;
            const float *sum = sums + m * (size + 1);
            for (long k = 0; k < size; k++) { /* an empty cluster keeps its initial centre */
                const float initial = m >= num_landmarks ? 0.0f : start[k * num_landmarks + m];
                const float value = m < num_landmarks && sum[size] ? sum[k] / sum[size] : initial;
                target[k * rows] = value;
                length += value * value;
            }
            target[size * rows] = m < num_landmarks ? -0.5f * length : -INFINITY;
        }
        memset(sums, 0, num_landmarks * (size + 1) * sizeof(float));
        SETS[level].assign(task, points, centres, tile, nearest, sums);
    }
}

static void run_lloyd(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    (void)piece, (void)first, (void)last;
    cluster(work->task, work->level, image, scratch);
}

int nlfilter_lloyd(int level, int threads, long images, long size, long count, long num_landmarks, long iterations,
                   float margin, const float *points, const float *start, int *nearest)
{
    struct lloyd task = {points, start, nearest, size, count, num_landmarks, iterations, margin};
    struct work work = {.run = run_lloyd, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .pieces = 1, .floats = (size + 1) * (2 * padded(num_landmarks, MOST_ROWS) + MOST_PIXELS)};
    return run_pieces(&work, threads);
}

/* Rows of S floats of the scratch memory before the points; the sums of blocks fit in one. */
static long pivot_rows(long num_landmarks)
{
    long most = 0;
    for (long first = 0; first < num_landmarks; first += pivot_block(first, num_landmarks))
        most = pivot_block(first, num_landmarks) > most ? pivot_block(first, num_landmarks) : most;
    return num_landmarks + TRIALS * most + 7;
}

static void run_pivots(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct pivots *task = work->task;
    float *points = scratch + pivot_rows(task->num_landmarks) * task->count; /* rows padded to a multiple of LINE */
    (void)piece, (void)first, (void)last;
    for (long k = 0; k < task->size; k++) {
        const float *row = task->points + (image * task->size + k) * task->used;
        memcpy(points + k * task->count, row, task->used * sizeof(float));
        memset(points + k * task->count + task->used, 0, (task->count - task->used) * sizeof(float));
    }
    SETS[work->level].pivots(task, points, task->pivots + image * task->num_landmarks, scratch);
}

int nlfilter_pivots(int level, int threads, long images, long size, long count, long num_landmarks, float captured,
                    const float *points, const float *draws, long *pivots)
{
    const long whole = padded(count, LINE);
    struct pivots task = {points, draws, pivots, size, count, whole, num_landmarks, captured};
    struct work work = {.run = run_pivots, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .pieces = 1, .floats = (pivot_rows(num_landmarks) + size) * whole};
    return run_pieces(&work, threads);
}
