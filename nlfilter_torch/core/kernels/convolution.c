/* Convolutions with 3x3 weights. */

#include "tasks.h"

static void run_convolution(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    struct convolution task = *(const struct convolution *)work->task;
    const long pixels = task.height * task.width;
    (void)piece;
    task.features += image * pixels * task.channels;
    task.out += image * pixels * task.outputs;
    task.added = task.added ? task.added + image * pixels * task.outputs : NULL;
    SETS[work->level].convolution(&task, first, last, scratch);
}

/* Weights and bias are padded with zeros to `padded_outputs`, a multiple of all register sizes, as are the channels. */
int nlfilter_convolution(int level, int threads, long images, long height, long width, long channels, long outputs,
                         long padded_outputs, long dilation, float slope, const float *features, const float *weights,
                         const float *bias, const float *added, float *out)
{
    const long apart = 4 * dilation;
    const struct convolution task = {
        .features = features, .weights = weights, .bias = bias, .added = added, .out = out, .height = height,
        .width = width, .channels = channels, .outputs = outputs, .padded_outputs = padded_outputs,
        .dilation = dilation, .tiles_down = (height + apart - 1) / apart, .tiles_across = (width + apart - 1) / apart,
        .slope = slope};
    struct work work = {
        .run = run_convolution, .task = &task, .level = level, .images = images,
        .pixels = dilation * dilation * task.tiles_down * task.tiles_across,
        .floats = channels + 36 * TILES * (channels + padded_outputs)};
    return divide(&work, threads, work.pixels);
}
