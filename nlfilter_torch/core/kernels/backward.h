/* Gradients through the columns of the Nystrom factor; defined in columns.py. */

/* Gradient of a tile of columns before they were scaled to norm at most 1, from the gradient after scaling. */
INLINE void NAME(column_gradients)(const struct backward *task, long start, long width, float *gradient, float *spare)
{
    const struct columns *columns = &task->columns;
    float *edge = spare, *right = spare + PIXELS;
    for (long k = 0; k < task->rank; k++) {
        float *target = task->left ? right : gradient;
        memcpy(target + k * PIXELS, NAME(fetch)(task->right + k * task->right_stride + start, width, 0.0f, edge),
               PIXELS * sizeof(float));
    }
    if (task->left)
        NAME(apply)(task->left, columns->num_landmarks, right, task->rank, gradient);
    if (!columns->limited)
        return;
    FLOATS along[VECTORS], scale[VECTORS];
    for (int v = 0; v < VECTORS; v++)
        along[v] = (FLOATS){0};
    for (long m = 0; m < columns->num_landmarks; m++) {
        const float *column = NAME(fetch)(columns->factor + m * columns->factor_stride + start, width, 0.0f, edge);
        for (int v = 0; v < VECTORS; v++)
            along[v] += *(const FLOATS *)(column + v * LANES) * *(const FLOATS *)(gradient + m * PIXELS + v * LANES);
    }
    for (int v = 0; v < VECTORS; v++)
        *(FLOATS *)(right + v * LANES) = along[v];
    for (long i = 0; i < PIXELS; i++) {
        edge[i] = i < width ? task->scale[start + i] : 1.0f;
        right[i] = edge[i] < 1.0f ? right[i] : i < width ? 2.0f * task->diagonal[start + i] : 0.0f;
    }
    for (int v = 0; v < VECTORS; v++) {
        scale[v] = *(const FLOATS *)(edge + v * LANES);
        along[v] = *(const FLOATS *)(right + v * LANES);
    }
    for (long m = 0; m < columns->num_landmarks; m++) {
        const float *column = NAME(fetch)(columns->factor + m * columns->factor_stride + start, width, 0.0f, edge);
        for (int v = 0; v < VECTORS; v++) {
            FLOATS *target = (FLOATS *)(gradient + m * PIXELS + v * LANES);
            *target = (*target - *(const FLOATS *)(column + v * LANES) * along[v]) * scale[v];
        }
    }
}

/* Gradient of a tile of features, from the gradient of the exponents (`slopes`). */
INLINE void NAME(feature_gradients)(const struct backward *task, long start, long width, const float *slopes,
                                    const float *features, float *moved)
{
    const long size = task->columns.size;
    NAME(apply)(task->points, size + 1, slopes, task->columns.num_landmarks, moved);
    for (long k = 0; k < size; k++) {
        for (int v = 0; v < VECTORS; v++)
            *(FLOATS *)(moved + k * PIXELS + v * LANES) -= *(const FLOATS *)(features + k * PIXELS + v * LANES) *
                                                           *(const FLOATS *)(moved + size * PIXELS + v * LANES);
        memcpy(task->moved + k * task->columns.pixels + start, moved + k * PIXELS, width * sizeof(float));
    }
}

/* totals (count, most) += left right^T, summed over the tiles. With `lower`, only the lower triangle. */
INLINE void NAME(add_products)(const float *left, long left_step, const float *right, long right_step, long tiles,
                               long count, long most, int lower, double *totals)
{
    for (long m = 0; m < count; m += ROWS)
        for (long n = 0; n < most && !(lower && n >= m + ROWS); n += VECTORS) {
            FLOATS sums[ROWS][VECTORS];
            NAME(correlate)(left + m * PIXELS, left_step, right + n * PIXELS, right_step, tiles, PIXELS, PIXELS, sums);
            for (int r = 0; r < ROWS; r++)
                for (int v = 0; v < VECTORS; v++)
                    if (m + r < count && n + v < most && !(lower && n + v > m + r))
                        totals[(m + r) * most + n + v] += NAME(total)(sums[r][v]);
        }
}

/* Gradients of the features of pixels first to last. totals += the gradient of the inverse Cholesky factor (M, M),
 * followed by the products of slopes and features (M, D + 1), from which the gradient of the landmarks is computed.
 * Processes as many tiles together as fit the cache. */
static TARGET void NAME(backward)(const struct backward *task, long first, long last, float *scratch, double *totals)
{
    const long size = task->columns.size, num_landmarks = task->columns.num_landmarks;
    const long step = task->rows * PIXELS, features_step = task->feature_rows * PIXELS;
    float *gradients = scratch, *affinities = gradients + task->tiles * step;
    float *features = affinities + task->tiles * step, *spare = features + task->tiles * features_step;
    for (long start = first; start < last; start += task->tiles * PIXELS) {
        const long end = last - start < task->tiles * PIXELS ? last : start + task->tiles * PIXELS;
        const long tiles = (end - start + PIXELS - 1) / PIXELS;
        for (long t = 0; t < tiles; t++) {
            const long at = start + t * PIXELS, width = end - at < PIXELS ? end - at : PIXELS;
            NAME(load_features)(&task->columns, at, width, features + t * features_step, spare);
            NAME(affinities)(&task->columns, features + t * features_step, affinities + t * step);
            NAME(column_gradients)(task, at, width, gradients + t * step, spare);
        }
        NAME(add_products)(gradients, step, affinities, step, tiles, num_landmarks, num_landmarks, task->lower, totals);
        for (long t = 0; t < tiles; t++) {
            const long at = start + t * PIXELS, width = end - at < PIXELS ? end - at : PIXELS;
            const float *rows = task->columns.inverse_cholesky, *gradient = gradients + t * step;
            float *slopes = affinities + t * step; /* gradient of the exponents, overwriting the affinities */
            for (long m = 0; m < num_landmarks; m += ROWS) {
                const long skipped = task->lower ? m : 0;
                FLOATS sums[ROWS][VECTORS];
                NAME(multiply)(rows, gradient + skipped * PIXELS, num_landmarks - skipped, sums);
                rows += (num_landmarks - skipped) * ROWS;
                for (int r = 0; r < ROWS; r++)
                    for (int v = 0; v < VECTORS; v++)
                        *(FLOATS *)(slopes + (m + r) * PIXELS + v * LANES) *= sums[r][v];
            }
            NAME(feature_gradients)(task, at, width, slopes, features + t * features_step, spare);
        }
        NAME(add_products)(affinities, step, features, features_step, tiles, num_landmarks, size + 1, 0,
                           totals + num_landmarks * num_landmarks);
    }
}
