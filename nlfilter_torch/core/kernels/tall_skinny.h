/* Tall-skinny products that read the factor once; defined in tall_skinny.py. */

#define LEAST (FLT_EPSILON / 4)

/* Pointers to the next `count` rows of the factor, with the last row repeated past the end. Reading several rows at
 * once makes better use of the memory bandwidth. */
INLINE void NAME(row_pointers)(const struct tall_skinny *task, long row, long start, int count, const float **rows)
{
    const long last = task->num_landmarks - 1;
    for (long k = 0; k < count; k++)
        rows[k] = task->factor + (row + k < last ? row + k : last) * task->factor_stride + start;
}

/* out = rows (R, M) times the columns first to last of the factor, at most CHUNK of them, times scaling. */
static TARGET void NAME(spread)(const struct tall_skinny *task, long first, long last)
{
    const long num_landmarks = task->num_landmarks, width = last - first, whole = width / LANES * LANES;
    for (long r = 0; r < task->count; r++)
        memset(task->out + r * task->pixels + first, 0, width * sizeof(float));
    for (long m = 0; m < num_landmarks; m += 8) {
        const float *column[8];
        NAME(row_pointers)(task, m, first, 8, column);
        for (long r = 0; r < task->count; r++) {
            float *sums = task->out + r * task->pixels + first, weight[8];
            for (long k = 0; k < 8; k++)
                weight[k] = m + k < num_landmarks ? task->rows[r * num_landmarks + m + k] : 0.0f;
            for (long i = 0; i < whole; i += LANES) {
                FLOATS sum = *(const FLOATS *)(sums + i);
#pragma GCC unroll 8
                for (int k = 0; k < 8; k++)
                    sum += weight[k] * *(const FLOATS *)(column[k] + i);
                *(FLOATS *)(sums + i) = sum;
            }
            for (long i = whole; i < width; i++)
                for (long k = 0; k < 8; k++)
                    sums[i] += weight[k] * column[k][i];
        }
    }
    for (long r = 0; task->scaling && r < task->count; r++)
        for (long i = first; i < last; i++)
            task->out[r * task->pixels + i] *= task->scaling[i];
}

/* totals (R, M) += images (R, N) times the transposed factor, over pixels first to last. */
static TARGET void NAME(gather)(const struct tall_skinny *task, long first, long last, double *totals)
{
    const long num_landmarks = task->num_landmarks;
    for (long start = first; start < last; start += CHUNK) {
        const long width = last - start < CHUNK ? last - start : CHUNK;
        const long whole = width / (2 * LANES) * (2 * LANES);
        for (long m = 0; m < num_landmarks; m += 4) {
            const float *column[4];
            NAME(row_pointers)(task, m, start, 4, column);
            for (long r = 0; r < task->count; r++) {
                const float *image = task->images + r * task->images_stride + start;
                FLOATS sums[4][2] = {{{0}}};
                for (long i = 0; i < whole; i += 2 * LANES) {
                    FLOATS left = *(const FLOATS *)(image + i), right = *(const FLOATS *)(image + i + LANES);
#pragma GCC unroll 4
                    for (int k = 0; k < 4; k++) {
                        sums[k][0] += left * *(const FLOATS *)(column[k] + i);
                        sums[k][1] += right * *(const FLOATS *)(column[k] + i + LANES);
                    }
                }
                for (long k = 0; k < 4 && m + k < num_landmarks; k++) {
                    FLOATS lanes = sums[k][0] + sums[k][1];
                    float sum = 0.0f;
                    for (int lane = 0; lane < LANES; lane++)
                        sum += lanes[lane];
                    for (long i = whole; i < width; i++)
                        sum += image[i] * column[k][i];
                    totals[r * num_landmarks + m + k] += sum;
                }
            }
        }
    }
}

/* For pixels first to last: out = the root d of d (u . 2 rows + c d) = 1, or without c the product of `spread`;
 * totals += factor diag(weights) out. Processes few pixels at a time, so that their columns stay cached for the second
 * product. */
static TARGET void NAME(sweep)(const struct tall_skinny *task, long first, long last, float *weighted, double *totals)
{
    const long step = sweep_step(task->num_landmarks);
    for (long start = first; start < last; start += step) {
        const long end = last - start < step ? last : start + step;
        NAME(spread)(task, start, end);
        for (long i = start; task->diagonal && i < end; i++) {
            /* positive_root of tall_skinny.py: without cancellation for either sign of u . t; finite if c = 0 */
            const float half = task->out[i], c = task->diagonal[i], root = sqrtf(half * half + c);
            const float over = half < 0.0f ? root - half : 1.0f, under = half < 0.0f ? c : root + half;
            const float d = over / (under < LEAST ? LEAST : under);
            task->out[i] = d > task->most ? task->most : d;
        }
        struct tall_skinny second = *task;
        for (long i = start; task->weights && i < end; i++)
            weighted[i - start] = task->out[i] * task->weights[i];
        if (task->weights)
            second.images = weighted - start;
        NAME(gather)(&second, start, end, totals);
    }
}
