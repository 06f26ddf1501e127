/* Convolution with 3x3 weights by the algorithm F(4x4, 3x3) of Lavin and Gray, "Fast Algorithms for Convolutional Neural
 * Networks" (2016): a tile of 4x4 results from 6x6 pixels takes 36 products of channels instead of 144. Defined in
 * convolution.py. */

/* Six values from six pixels: the matrix B^T of the paper. */
INLINE void NAME(transform)(const FLOATS x[6], FLOATS out[6])
{
    const FLOATS even = x[4] - 4.0f * x[2], odd = x[3] - 4.0f * x[1];
    const FLOATS difference = x[4] - x[2], twice = 2.0f * (x[3] - x[1]);
    out[0] = 4.0f * x[0] - 5.0f * x[2] + x[4];
    out[1] = even + odd;
    out[2] = even - odd;
    out[3] = difference + twice;
    out[4] = difference - twice;
    out[5] = 4.0f * x[1] - 5.0f * x[3] + x[5];
}

/* Four results from the products of six values: the matrix A^T of the paper. */
INLINE void NAME(restore)(const FLOATS x[6], FLOATS out[4])
{
    const FLOATS sum = x[1] + x[2], difference = x[1] - x[2], sum2 = x[3] + x[4], difference2 = x[3] - x[4];
    out[0] = x[0] + sum + sum2;
    out[1] = difference + 2.0f * difference2;
    out[2] = sum + 4.0f * sum2;
    out[3] = difference + 8.0f * difference2 + x[5];
}

/* x where it is positive, otherwise slope times x. */
INLINE FLOATS NAME(leaky)(FLOATS x, float slope)
{
    const INTS below = x < 0.0f;
    return (FLOATS)(((INTS)(slope * x) & below) | ((INTS)x & ~below));
}

/* out (ROWS, vectors * LANES) = rows (ROWS, depth) times a matrix (depth, vectors * LANES) with rows `stride` apart. */
INLINE void NAME(mix)(const float *rows, long depth, const float *matrix, long stride, float *out, const int vectors)
{
    FLOATS sums[ROWS][VECTORS];
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
        for (int v = 0; v < vectors; v++)
            sums[r][v] = (FLOATS){0};
    for (long k = 0; k < depth; k++) {
        FLOATS columns[VECTORS];
#pragma GCC unroll 8
        for (int v = 0; v < vectors; v++)
            columns[v] = *(const FLOATS *)(matrix + k * stride + v * LANES);
#pragma GCC unroll 8
        for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
            for (int v = 0; v < vectors; v++)
                sums[r][v] += rows[r * depth + k] * columns[v];
    }
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; r++)
#pragma GCC unroll 8
        for (int v = 0; v < vectors; v++)
            *(FLOATS *)(out + r * stride + v * LANES) = sums[r][v];
}

/* Products (36, TILES, outputs) of the transformed pixels (36, TILES, channels) of `count` tiles with the weights. */
INLINE void NAME(products)(const struct convolution *task, long count, const float *pixels, float *products)
{
    const long channels = task->channels, outputs = task->padded_outputs;
    for (long k = 0; k < 36; k++)
        for (long o = 0; o < outputs; o += VECTORS * LANES)
            for (long t = 0; t < count; t += ROWS) {
                const float *rows = pixels + (k * TILES + t) * channels;
                const float *matrix = task->weights + k * channels * outputs + o;
                float *out = products + (k * TILES + t) * outputs + o;
                switch (outputs - o < VECTORS * LANES ? (outputs - o) / LANES : VECTORS) {
                case 1: NAME(mix)(rows, channels, matrix, outputs, out, 1); break;
                case 2: NAME(mix)(rows, channels, matrix, outputs, out, 2); break;
                case 3: NAME(mix)(rows, channels, matrix, outputs, out, 3); break;
                default: NAME(mix)(rows, channels, matrix, outputs, out, VECTORS);
                }
            }
}

/* Transform the rectified pixels of a tile whose results begin at (top, left): 36 rows of channels, TILES rows apart.
 * Pixels outside the picture are `zeros`. */
INLINE void NAME(transform_tile)(const struct convolution *task, long top, long left, const float *zeros, float *out)
{
    const long channels = task->channels, apart = task->dilation;
    const float *sources[6][6];
    for (long i = 0; i < 6; i++)
        for (long j = 0; j < 6; j++) {
            const long y = top + (i - 1) * apart, x = left + (j - 1) * apart;
            const int inside = y >= 0 && y < task->height && x >= 0 && x < task->width;
            sources[i][j] = inside ? task->features + (y * task->width + x) * channels : zeros;
        }
    for (long c = 0; c < channels; c += LANES) {
        FLOATS rows[6][6];
        for (int j = 0; j < 6; j++) {
            FLOATS column[6], values[6];
#pragma GCC unroll 6
            for (int i = 0; i < 6; i++)
                column[i] = NAME(leaky)(*(const FLOATS *)(sources[i][j] + c), task->slope);
            NAME(transform)(column, values);
#pragma GCC unroll 6
            for (int i = 0; i < 6; i++)
                rows[i][j] = values[i];
        }
        for (int i = 0; i < 6; i++) {
            FLOATS values[6];
            NAME(transform)(rows[i], values);
#pragma GCC unroll 6
            for (int j = 0; j < 6; j++)
                *(FLOATS *)(out + (i * 6 + j) * TILES * channels + c) = values[j];
        }
    }
}

/* Compute the results of a tile from its products, 36 rows of outputs, TILES rows apart; add bias and `added`. */
INLINE void NAME(restore_tile)(const struct convolution *task, long top, long left, const float *products)
{
    const long outputs = task->outputs, apart = task->dilation;
    for (long o = 0; o < outputs; o += LANES) {
        const long width = outputs - o < LANES ? outputs - o : LANES;
        const FLOATS bias = *(const FLOATS *)(task->bias + o);
        FLOATS rows[4][6];
        for (int j = 0; j < 6; j++) {
            FLOATS column[6], values[4];
#pragma GCC unroll 6
            for (int i = 0; i < 6; i++)
                column[i] = *(const FLOATS *)(products + (i * 6 + j) * TILES * task->padded_outputs + o);
            NAME(restore)(column, values);
#pragma GCC unroll 4
            for (int i = 0; i < 4; i++)
                rows[i][j] = values[i];
        }
        for (int i = 0; i < 4 && top + i * apart < task->height; i++) {
            FLOATS values[4];
            NAME(restore)(rows[i], values);
            for (int j = 0; j < 4 && left + j * apart < task->width; j++) {
                const long place = ((top + i * apart) * task->width + left + j * apart) * outputs + o;
                FLOATS sum = values[j] + bias;
                if (width == LANES) {
                    if (task->added)
                        sum += *(const FLOATS *)(task->added + place);
                    *(FLOATS *)(task->out + place) = sum;
                } else
                    for (long k = 0; k < width; k++)
                        task->out[place + k] = sum[k] + (task->added ? task->added[place + k] : 0.0f);
            }
        }
    }
}

/* Compute tiles first to last. Those of each phase of the dilation, whose pixels are `dilation` apart, follow each other
 * row by row. */
static TARGET void NAME(convolution)(const struct convolution *task, long first, long last, float *scratch)
{
    const long channels = task->channels, apart = task->dilation, across = task->tiles_across;
    const long per_phase = task->tiles_down * across; /* tiles of a phase */
    float *zeros = scratch, *pixels = zeros + channels, *products = pixels + 36 * TILES * channels;
    memset(zeros, 0, channels * sizeof(float));
    for (long start = first; start < last; start += TILES) {
        const long count = last - start < TILES ? last - start : TILES;
        long top[TILES], left[TILES];
        for (long t = 0; t < count; t++) {
            const long phase = (start + t) / per_phase, tile = (start + t) % per_phase;
            top[t] = phase / apart + 4 * apart * (tile / across);
            left[t] = phase % apart + 4 * apart * (tile % across);
            NAME(transform_tile)(task, top[t], left[t], zeros, pixels + t * channels);
        }
        NAME(products)(task, count, pixels, products);
        for (long t = 0; t < count; t++)
            NAME(restore_tile)(task, top[t], left[t], products + t * task->padded_outputs);
    }
}
