/* Tall-skinny products: the factor times a few rows. */

#include "tasks.h"

/* The task of a single image of the batch. */
static struct tall_skinny part(const struct work *work, long image)
{
    struct tall_skinny task = *(const struct tall_skinny *)work->task;
    task.factor += image * task.factor_step;
    task.rows = task.rows ? task.rows + image * task.count * task.num_landmarks : NULL;
    task.images = task.images ? task.images + image * task.images_step : NULL;
    task.out = task.out ? task.out + image * task.count * task.pixels : NULL;
    task.scaling = task.scaling ? task.scaling + image * task.pixels : NULL;
    task.diagonal = task.diagonal ? task.diagonal + image * task.pixels : NULL;
    task.weights = task.weights ? task.weights + image * task.pixels : NULL;
    return task;
}

static void run_spread(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct tall_skinny task = part(work, image);
    (void)piece, (void)scratch;
    SETS[work->level].spread(&task, first, last);
}

int nlfilter_spread(int level, int threads, long pixels, long images, long num_landmarks,
                    const float *factor, long factor_step, long factor_stride, long count, const float *rows,
                    const float *scaling, float *out)
{
    struct tall_skinny task = {
        .factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .num_landmarks = num_landmarks,
        .count = count, .rows = rows, .scaling = scaling, .out = out, .pixels = pixels};
    struct work work = {.run = run_spread, .task = &task, .level = level, .images = images, .pixels = pixels};
    return divide(&work, threads, CHUNK);
}

static void run_gather(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct tall_skinny task = part(work, image);
    (void)scratch;
    SETS[work->level].gather(&task, first, last, work->totals + piece * task.count * task.num_landmarks);
}

int nlfilter_gather(int level, int threads, long pixels, long images, long num_landmarks,
                    const float *factor, long factor_step, long factor_stride, long count, const float *planes,
                    long planes_step, long planes_stride, double *out)
{
    struct tall_skinny task = {
        .factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .num_landmarks = num_landmarks,
        .count = count, .images = planes, .images_step = planes_step, .images_stride = planes_stride,
        .pixels = pixels};
    struct work work = {.run = run_gather, .task = &task, .level = level, .images = images, .pixels = pixels};
    return add_up(&work, threads, count * num_landmarks, out);
}

static void run_sweep(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct tall_skinny task = part(work, image);
    SETS[work->level].sweep(&task, first, last, scratch, work->totals + piece * task.num_landmarks);
}

/* With `diagonal`: out = the scaling d and moment = factor d, where row is half of the estimated moment.
 * Without: moment = factor diag(scaling) factor^T row, with out as working memory. */
int nlfilter_sweep(int level, int threads, long pixels, long images, long num_landmarks,
                   const float *factor, long factor_step, long factor_stride, const float *row,
                   const float *scaling, const float *diagonal, const float *weights, float most, float *out,
                   double *moment)
{
    struct tall_skinny task = {
        .factor = factor, .factor_stride = factor_stride, .factor_step = factor_step, .num_landmarks = num_landmarks,
        .count = 1, .rows = row, .scaling = scaling, .diagonal = diagonal, .weights = weights, .most = most,
        .images = out, .images_step = pixels, .out = out, .pixels = pixels};
    struct work work = {.run = run_sweep, .task = &task, .level = level, .images = images, .pixels = pixels,
                        .floats = weights ? sweep_step(num_landmarks) : 0};
    return add_up(&work, threads, num_landmarks, moment);
}
