/* Columns of the Nystrom factor and their gradients. */

#include "tasks.h"

/* Pack each matrix (count, depth) of a batch into blocks of `rows` rows, each block stored by columns and padded with
 * zero rows. If `depths` (B, blocks) is given, trailing zero columns of a block are dropped and its depth recorded. */
static float *pack(const float *matrix, long images, long count, long depth, long rows, long *depths)
{
    const long whole = padded(count, rows);
    float *packed = malloc(images * whole * depth * sizeof(float));
    for (long image = 0; packed && image < images; image++, matrix += count * depth) {
        float *target = packed + image * whole * depth;
        for (long m = 0; m < count; m += rows) {
            long used = depths ? 0 : depth;
            for (long r = m; r < m + rows && r < count; r++)
                for (long k = used; k < depth; k++)
                    if (matrix[r * depth + k] != 0.0f)
                        used = k + 1;
            if (depths)
                *depths++ = used;
            for (long k = 0; k < used; k++)
                for (long r = m; r < m + rows; r++)
                    *target++ = r < count ? matrix[r * depth + k] : 0.0f;
        }
    }
    return packed;
}

/* Pack the transposes of square matrices into the same blocks. If the matrices are lower triangles, leading zero
 * columns of a block are dropped. */
static float *pack_transposes(const float *matrix, long images, long size, long rows, int lower)
{
    const long whole = padded(size, rows);
    float *packed = malloc(images * whole * size * sizeof(float));
    for (long image = 0; packed && image < images; image++, matrix += size * size) {
        float *target = packed + image * whole * size;
        for (long m = 0; m < size; m += rows)
            for (long k = lower ? m : 0; k < size; k++)
                for (long r = m; r < m + rows; r++)
                    *target++ = r < size ? matrix[k * size + r] : 0.0f;
    }
    return packed;
}

static int are_lower(const float *matrix, long images, long size)
{
    for (long m = 0; m < images * size; m++)
        for (long n = m % size + 1; n < size; n++)
            if (matrix[m * size + n] != 0.0f)
                return 0;
    return 1;
}

/* The task of a single image of the batch. */
static struct columns of_image(struct columns task, long image, long rows)
{
    const long whole = padded(task.num_landmarks, rows);
    task.features += image * task.features_step;
    task.centre += image * task.size;
    task.factor += image * task.factor_step;
    task.norms = task.norms ? task.norms + image * task.pixels : NULL;
    task.landmarks += image * whole * (task.size + 2);
    task.inverse_cholesky += image * whole * task.num_landmarks;
    task.depths = task.depths ? task.depths + image * whole / rows : NULL;
    return task;
}

static void run_columns(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct columns task = of_image(*(const struct columns *)work->task, image, SETS[work->level].rows);
    (void)piece;
    SETS[work->level].columns(&task, first, last, scratch);
}

int nlfilter_columns(int level, int threads, long pixels, long images, long size, long num_landmarks,
                     const float *features, long features_step, long features_stride, const float *centre,
                     const float *landmarks, const float *inverse_cholesky, float floor, int limited, float *factor,
                     long factor_step, long factor_stride, float *norms)
{
    const long rows = SETS[level].rows, whole = padded(num_landmarks, rows);
    long *depths = malloc(images * whole / rows * sizeof(long));
    float *packed = pack(landmarks, images, num_landmarks, size + 2, rows, NULL);
    float *packed_inverse = depths ? pack(inverse_cholesky, images, num_landmarks, num_landmarks, rows, depths) : NULL;
    const struct columns task = {
        .features = features, .features_step = features_step, .features_stride = features_stride, .centre = centre,
        .factor = factor, .factor_step = factor_step, .factor_stride = factor_stride, .norms = norms, .pixels = pixels,
        .size = size, .num_landmarks = num_landmarks, .floor = floor, .limited = limited, .landmarks = packed,
        .inverse_cholesky = packed_inverse, .depths = depths};
    struct work work = {.run = run_columns, .task = &task, .level = level, .images = images, .pixels = pixels,
                        .floats = (size + 3 + 2 * whole) * MOST_PIXELS};
    const int status = packed && packed_inverse ? divide(&work, threads, CHUNK) : -1;
    free(depths);
    free(packed);
    free(packed_inverse);
    return status;
}

static void run_backward(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    struct backward task = *(const struct backward *)work->task;
    const long rows = SETS[work->level].rows, num_landmarks = task.columns.num_landmarks, size = task.columns.size;
    task.columns = of_image(task.columns, image, rows);
    task.left = task.left ? task.left + image * padded(num_landmarks, rows) * task.rank : NULL;
    task.right += image * task.right_step;
    task.scale += image * task.columns.pixels;
    task.diagonal += image * task.columns.pixels;
    task.points += image * padded(size + 1, rows) * num_landmarks;
    task.moved += image * size * task.columns.pixels;
    double *totals = work->totals + piece * num_landmarks * (num_landmarks + size + 1);
    SETS[work->level].backward(&task, first, last, scratch, totals);
}

/* The gradient of the columns is left right; if `left` is NULL, it is `right` and `rank` the number of landmarks. */
int nlfilter_backward(int level, int threads, long pixels, long images, long size, long num_landmarks,
                      const float *features, long features_step, long features_stride, const float *centre,
                      const float *landmarks, const float *inverse_cholesky, float floor, int limited, float *factor,
                      long factor_step, long factor_stride, const float *scale, long rank, const float *left,
                      const float *right, long right_step, long right_stride, const float *diagonal,
                      const float *points, float *moved, double *totals)
{
    const long rows = SETS[level].rows, tile_rows = padded(num_landmarks, 12), feature_rows = padded(size + 2, 4);
    const long fitting = NEAR / (2 * tile_rows + feature_rows) / MOST_PIXELS;
    const long spare = 2 + (rank > padded(size + 1, rows) ? rank : padded(size + 1, rows));
    const int lower = are_lower(inverse_cholesky, images, num_landmarks);
    float *packed[] = {pack(landmarks, images, num_landmarks, size + 2, rows, NULL),
                       pack_transposes(inverse_cholesky, images, num_landmarks, rows, lower),
                       pack(points, images, size + 1, num_landmarks, rows, NULL),
                       left ? pack(left, images, num_landmarks, rank, rows, NULL) : NULL};
    const struct backward task = {
        .columns = {.features = features, .features_step = features_step, .features_stride = features_stride,
                    .centre = centre, .factor = factor, .factor_step = factor_step, .factor_stride = factor_stride,
                    .pixels = pixels, .size = size, .num_landmarks = num_landmarks, .floor = floor, .limited = limited,
                    .landmarks = packed[0], .inverse_cholesky = packed[1]},
        .points = packed[2], .left = packed[3], .right = right, .rank = rank, .right_step = right_step,
        .right_stride = right_stride, .scale = scale, .diagonal = diagonal, .moved = moved, .lower = lower,
        .tiles = fitting < 1 ? 1 : fitting > 16 ? 16 : fitting, .rows = tile_rows, .feature_rows = feature_rows};
    struct work work = {.run = run_backward, .task = &task, .level = level, .images = images, .pixels = pixels,
                        .floats = (task.tiles * (2 * tile_rows + feature_rows) + spare) * MOST_PIXELS};
    const int enough = packed[0] && packed[1] && packed[2] && (packed[3] || !left);
    const int status = enough ? add_up(&work, threads, num_landmarks * (num_landmarks + size + 1), totals) : -1;
    for (int k = 0; k < 4; k++)
        free(packed[k]);
    return status;
}
