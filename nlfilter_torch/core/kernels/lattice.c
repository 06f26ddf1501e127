/* Interpolation in a lattice of colours. */

#include "tasks.h"

static void run_lattice(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    struct lattice task = *(const struct lattice *)work->task;
    (void)piece;
    (void)scratch;
    task.colours += image * task.colours_step;
    task.lattice += image * task.lattice_step;
    task.out += 3 * image * task.pixels;
    SETS[work->level].lattice(&task, first, last);
}

int nlfilter_lattice(int level, int threads, long pixels, long images, long nodes, const float *colours,
                     long colours_step, long colours_stride, const float *lattice, long lattice_step, float *out)
{
    const struct lattice task = {colours, lattice, out, nodes, pixels, colours_step, colours_stride, lattice_step};
    struct work work = {.run = run_lattice, .task = &task, .level = level, .images = images, .pixels = pixels};
    return divide(&work, threads, CHUNK);
}
