/* Gram matrices of the scaled factor. */

#include "tasks.h"

static void run_grams(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    struct grams task = *(const struct grams *)work->task;
    task.factor += image * task.factor_step;
    task.scaling += image * work->pixels;
    task.remainder += image * work->pixels;
    double *totals = work->totals + piece * task.count * task.num_landmarks * task.num_landmarks;
    SETS[work->level].grams(&task, first, last, scratch, totals);
}

int nlfilter_grams(int level, int threads, long pixels, long images, long num_landmarks,
                   const float *factor, long factor_step, long factor_stride, long count, const float *scaling,
                   const float *remainder, double *out)
{
    const long rows = padded(num_landmarks, 12), fitting = NEAR / rows / 64 * 64; /* a multiple of all block sizes */
    const struct grams task = {
        .factor = factor, .factor_step = factor_step, .factor_stride = factor_stride, .scaling = scaling,
        .remainder = remainder, .num_landmarks = num_landmarks, .count = count, .rows = rows,
        .step = fitting < 64 ? 64 : fitting > 1024 ? 1024 : fitting};
    struct work work = {.run = run_grams, .task = &task, .level = level, .images = images, .pixels = pixels,
                        .floats = (1 + MOST_ROWS + rows) * task.step};
    const int status = add_up(&work, threads, count * num_landmarks * num_landmarks, out);
    for (long k = 0; k < images * count; k++, out += num_landmarks * num_landmarks)
        for (long m = 0; m < num_landmarks; m++)
            for (long n = m + 1; n < num_landmarks; n++)
                out[m * num_landmarks + n] = out[n * num_landmarks + m];
    return status;
}
