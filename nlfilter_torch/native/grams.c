/* Gram matrices of the scaled factor. */

#include "tasks.h"

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
