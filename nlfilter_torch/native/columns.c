/* Columns of the Nystrom factor, and their derivatives. */

#include "tasks.h"

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

/* The transpose of a square matrix in blocks of `rows` of its rows, as above; of a lower triangle each block begins
 * with the first column that is not zero in it. */
static float *pack_transpose(const float *matrix, long size, long rows, int lower)
{
    float *packed = malloc(padded(size, rows) * size * sizeof(float)), *target = packed;
    for (long m = 0; packed && m < size; m += rows)
        for (long k = lower ? m : 0; k < size; k++)
            for (long r = m; r < m + rows; r++)
                *target++ = r < size ? matrix[k * size + r] : 0.0f;
    return packed;
}

static int is_lower(const float *matrix, long size)
{
    for (long m = 0; m < size; m++)
        for (long n = m + 1; n < size; n++)
            if (matrix[m * size + n] != 0.0f)
                return 0;
    return 1;
}

static void run_backward(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct backward *task = work->task;
    const long sums = task->columns.marks * (task->columns.marks + task->columns.size + 1);
    (void)image;
    SETS[work->level].backward(task, first, last, scratch, work->totals + piece * sums);
}

/* left is NULL, and right the gradient of the columns itself, where rank is the number of landmarks. */
int nlfilter_backward(int level, int threads, long pixels, long size, long marks, const float *features,
                      long features_stride, const float *centre, const float *landmarks, const float *whitening,
                      float floor, int limited, float *factor, long factor_stride, const float *scale, long rank,
                      const float *left, const float *right, long right_stride, const float *diagonal,
                      const float *points, float *moved, double *totals)
{
    const long rows = SETS[level].rows, tile_rows = padded(marks, 12), feature_rows = padded(size + 2, 4);
    const long spare = 2 + (rank > padded(size + 1, rows) ? rank : padded(size + 1, rows));
    const long fitting = NEAR / (2 * tile_rows + feature_rows) / MOST_PIXELS, lower = is_lower(whitening, marks);
    float *packed[] = {pack(landmarks, marks, size + 2, rows, NULL), pack_transpose(whitening, marks, rows, lower),
                       pack(points, size + 1, marks, rows, NULL), left ? pack(left, marks, rank, rows, NULL) : NULL};
    const struct backward task = {
        .columns = {features, centre, factor, NULL, features_stride, factor_stride, size, marks, floor, limited,
                    packed[0], packed[1], NULL},
        .left = packed[3], .right = right, .rank = rank, .right_stride = right_stride, .scale = scale,
        .diagonal = diagonal, .points = packed[2], .moved = moved, .moved_stride = pixels, .lower = lower,
        .tiles = fitting < 1 ? 1 : fitting > 16 ? 16 : fitting, .rows = tile_rows, .feature_rows = feature_rows};
    struct work work = {.run = run_backward, .task = &task, .level = level, .images = 1, .pixels = pixels,
                        .floats = (task.tiles * (2 * tile_rows + feature_rows) + spare) * MOST_PIXELS};
    const int short_of_memory = !packed[0] || !packed[1] || !packed[2] || (left && !packed[3]);
    const int status = short_of_memory ? -1 : add_up(&work, threads, marks * (marks + size + 1), totals);
    for (int k = 0; k < 4; k++)
        free(packed[k]);
    return status;
}
