/* Columns of the Nystrom factor from features; defined in columns.py. */

/* Load a tile of centred features x and append a row of ones and a row of |x|^2. Pixels past the image are 0. */
INLINE void NAME(load_features)(const struct columns *task, long start, long width, float *features, float *edge)
{
    FLOATS norm[VECTORS];
    for (int v = 0; v < VECTORS; v++)
        norm[v] = (FLOATS){0};
    for (long k = 0; k < task->size; k++, features += PIXELS) {
        const float centre = task->centre[k];
        const float *source = NAME(fetch)(task->features + k * task->features_stride + start, width, centre, edge);
        for (int v = 0; v < VECTORS; v++) {
            const FLOATS centred = *(const FLOATS *)(source + v * LANES) - centre;
            *(FLOATS *)(features + v * LANES) = centred;
            norm[v] += centred * centred;
        }
    }
    for (int v = 0; v < VECTORS; v++) {
        *(FLOATS *)(features + v * LANES) = (FLOATS){0} + 1.0f;
        *(FLOATS *)(features + PIXELS + v * LANES) = norm[v];
    }
}

/* Affinities of a tile of pixels to the landmarks. */
INLINE void NAME(affinities)(const struct columns *task, const float *features, float *affinities)
{
    for (long m = 0; m < task->num_landmarks; m += ROWS) {
        FLOATS exponents[ROWS][VECTORS];
        NAME(multiply)(task->landmarks + m * (task->size + 2), features, task->size + 2, exponents);
        for (int r = 0; r < ROWS; r++)
            for (int v = 0; v < VECTORS; v++)
                *(FLOATS *)(affinities + (m + r) * PIXELS + v * LANES) =
                    NAME(exp2)(NAME(clamp)(exponents[r][v], task->floor, 0.0f));
    }
}

/* Columns of the factor for pixels first to last: affinities times the inverse Cholesky factor, with `limited` scaled
 * to norm at most 1. */
static TARGET void NAME(columns)(const struct columns *task, long first, long last, float *scratch)
{
    const long num_landmarks = task->num_landmarks;
    float *features = scratch, *affinities = features + (task->size + 2) * PIXELS;
    float *solutions = affinities + padded(num_landmarks, ROWS) * PIXELS;
    float *edge = solutions + padded(num_landmarks, ROWS) * PIXELS; /* a row of the last, partial tile */
    for (long start = first; start < last; start += PIXELS) {
        const long width = last - start < PIXELS ? last - start : PIXELS;
        FLOATS norm[VECTORS];
        for (int v = 0; v < VECTORS; v++)
            norm[v] = (FLOATS){0};
        NAME(load_features)(task, start, width, features, edge);
        NAME(affinities)(task, features, affinities);
        const float *rows = task->inverse_cholesky;
        for (long m = 0, block = 0; m < num_landmarks; m += ROWS, block++) {
            FLOATS sums[ROWS][VECTORS];
            NAME(multiply)(rows, affinities, task->depths[block], sums);
            rows += task->depths[block] * ROWS;
            for (int r = 0; r < ROWS; r++) /* padding rows are zero */
                for (int v = 0; v < VECTORS; v++) {
                    *(FLOATS *)(solutions + (m + r) * PIXELS + v * LANES) = sums[r][v];
                    norm[v] += sums[r][v] * sums[r][v];
                }
        }
        /* Norms exceed 1 only by rounding, but possibly at many pixels: all those equal to a landmark. */
        FLOATS scale[VECTORS];
        for (int v = 0; v < VECTORS; v++)
            *(FLOATS *)(edge + v * LANES) = norm[v];
        if (task->limited)
            memcpy(task->norms + start, edge, width * sizeof(float));
        for (long i = 0; i < PIXELS; i++)
            edge[i] = task->limited && edge[i] > 1.0f ? 1.0f / sqrtf(edge[i]) : 1.0f;
        for (int v = 0; v < VECTORS; v++)
            scale[v] = *(const FLOATS *)(edge + v * LANES);
        for (long m = 0; m < num_landmarks; m++) {
            float *target = task->factor + m * task->factor_stride + start;
            const float *row = solutions + m * PIXELS;
            const int streamed = width == PIXELS && (uintptr_t)target % sizeof(FLOATS) == 0;
            for (int v = 0; v < VECTORS; v++) {
                const FLOATS value = *(const FLOATS *)(row + v * LANES) * scale[v];
                if (streamed)
                    STREAM(target + v * LANES, value);
                else
                    *(FLOATS *)((width == PIXELS ? target : edge) + v * LANES) = value;
            }
            if (width < PIXELS)
                memcpy(target, edge, width * sizeof(float));
        }
    }
    FENCE(); /* complete the streaming stores before other threads read them */
}
