/* Newton's method for the scaling of kernels with a unit diagonal, and the linear system of its gradient; defined in
 * nlfilter_torch/operator/scaling.py, where the methods are explained. */

#include <math.h>

#include "tasks.h"

#define FEW 1048576      /* elements of a factor below which waking another thread takes longer than it saves, */
#define FEW_GRAMS 262144 /* and of a Gram matrix; as in library.py */

/* Points of an image: all of them, or a sample. */
struct points {
    const float *factor, *diagonal, *weights; /* (M, n), (n), and (n) or NULL for one each */
    long stride, count;
    double every; /* number of pixels that each point stands for, besides its weight */
};

struct balancing {
    struct points whole; /* of the first image */
    long step, num_landmarks, pixels;
    const long *explored; /* numbers of the points of the first guess, or NULL for all of them */
    long explored_count, sampled_count, most_sweeps, sample_steps, guesses;
    float tolerance, most;
    float *scaling, *residual; /* (B, N), (B) */
    double *moment, *inverse;  /* (B, M), (B, M, M) */
    long *steps;               /* (B) */
    int level, threads;        /* threads of each image */
};

/* Working memory of an image. */
struct memory {
    float *half, *rows, *drawn, *drawn_diagonal, *drawn_weights, *leverage;
    double *total, *actual, *right, *slope, *error, *before, *change, *moved;
    long *places;
};

static int suited(const struct balancing *task, const struct points *points, long few)
{
    return task->num_landmarks * points->count < few ? 1 : task->threads;
}

static void halve(const double *total, float *half, long count)
{
    for (long m = 0; m < count; m++)
        half[m] = (float)(total[m] / 2);
}

/* The scaling d(t) of points, and its moment. */
static int sweep(const struct balancing *task, const struct points *points, const double *total, float *half,
                 float *scaling, double *actual)
{
    halve(total, half, task->num_landmarks);
    const int status =
        nlfilter_sweep(task->level, suited(task, points, FEW), points->count, 1, task->num_landmarks, points->factor, 0,
                       points->stride, half, NULL, points->diagonal, points->weights, task->most, scaling, actual);
    for (long m = 0; m < task->num_landmarks; m++)
        actual[m] *= points->every;
    return status;
}

/* actual = the moment of values (n), which are multiplied by the weights. */
static int moment(const struct balancing *task, const struct points *points, float *values, double *actual)
{
    for (long i = 0; points->weights && i < points->count; i++)
        values[i] *= points->weights[i];
    const int status = nlfilter_gather(task->level, suited(task, points, FEW), points->count, 1, task->num_landmarks,
                                       points->factor, 0, points->stride, 1, values, 0, 0, actual);
    for (long m = 0; m < task->num_landmarks; m++)
        actual[m] *= points->every;
    return status;
}

static int spread(const struct balancing *task, const struct points *points, long count, const float *rows,
                  const float *scaling, float *out)
{
    return nlfilter_spread(task->level, suited(task, points, FEW), points->count, 1, task->num_landmarks,
                           points->factor, 0, points->stride, count, rows, scaling, out);
}

/* Columns of the points of a sample. */
struct columns_of {
    const struct points *whole;
    const long *places;
    float *out;
    long num_landmarks, count;
};

static void run_copy(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct columns_of *task = work->task;
    (void)image, (void)piece, (void)scratch;
    for (long m = 0; m < task->num_landmarks; m++)
        for (long i = first; i < last; i++)
            task->out[m * task->count + i] = task->whole->factor[m * task->whole->stride + task->places[i]];
}

/* The points with the numbers `places`. */
static int sample_of(const struct balancing *task, const struct points *whole, const long *places, long count,
                     const float *weights, double every, struct memory *memory, struct points *sample)
{
    struct columns_of columns = {whole, places, memory->drawn, task->num_landmarks, count};
    struct work work = {.run = run_copy, .task = &columns, .level = task->level, .images = 1, .pixels = count};
    *sample = (struct points){memory->drawn, memory->drawn_diagonal, weights, count, count, every};
    for (long i = 0; i < count; i++)
        memory->drawn_diagonal[i] = whole->diagonal[places[i]];
    return divide(&work, suited(task, sample, FEW), CHUNK);
}

/* Numbers of the points at which the sum of `shares` (n) reaches (tick + 1/2) / ticks of the `total`, in order. */
static void reached(const float *shares, long count, double total, const long *ticks, double most, long wanted,
                    long *places)
{
    double sum = 0.0;
    long k = 0;
    for (long i = 0; i < count; i++)
        for (sum += shares[i]; k < wanted && ((ticks ? ticks[k] : k) + 0.5) / most * total <= sum; k++)
            places[k] = i;
    for (; k < wanted; k++)
        places[k] = count - 1;
}

static double sum_of(const float *values, long count)
{
    double sum = 0.0;
    for (long i = 0; i < count; i++)
        sum += values[i];
    return sum;
}

/* The first guess of the moment: _guess in scaling.py. */
static int guess(const struct balancing *task, const struct points *whole, struct memory *memory)
{
    struct points sample = *whole;
    const long *places = task->explored, count = task->explored_count, landmarks = task->num_landmarks;
    float *values = memory->leverage, *rows = memory->rows;
    int failed = 0;
    if (places) {
        double every = (double)whole->count / count;
        if (whole->weights) { /* in proportion to the weights, so that no point of weight 0 is drawn */
            const double total = sum_of(whole->weights, whole->count);
            reached(whole->weights, whole->count, total, places, whole->count, count, memory->places);
            places = memory->places, every = total / count;
        }
        failed |= sample_of(task, whole, places, count, NULL, every, memory, &sample);
    }
    for (long i = 0; i < sample.count; i++)
        values[i] = 1.0f;
    failed |= moment(task, &sample, values, memory->actual);
    for (long m = 0; m < landmarks; m++)
        memory->half[m] = (float)memory->actual[m];
    failed |= spread(task, &sample, 1, memory->half, NULL, rows);
    for (long i = 0; i < sample.count; i++) { /* no row of K sums to less than its unit diagonal */
        const float sum = rows[i] + sample.diagonal[i];
        rows[i] = 1.0f / sqrtf(sum < 1.0f ? 1.0f : sum);
    }
    failed |= moment(task, &sample, rows, memory->total);
    for (long step = 0; step < task->guesses; step++) {
        failed |= sweep(task, &sample, memory->total, memory->half, rows, memory->actual);
        for (long m = 0; m < landmarks; m++)
            memory->total[m] = (memory->total[m] + memory->actual[m]) / 2;
    }
    return failed;
}

/* A sample in proportion to leverage scores: _draw in scaling.py. Of few points all are the sample. */
static int draw(const struct balancing *task, const struct points *whole, const float *scaling, struct memory *memory,
                struct points *sample)
{
    const long pixels = whole->count, count = task->sampled_count;
    float *leverage = memory->leverage;
    *sample = *whole;
    if (!count)
        return 0;
    for (long i = 0; i < pixels; i++) {
        const float square = scaling[i] * scaling[i], c = whole->diagonal[i]; /* |u|^2 is 1 - c */
        leverage[i] = square * (1.0f - c) / (1.0f + square * c) * (whole->weights ? whole->weights[i] : 1.0f);
    }
    const float least = (float)(sum_of(leverage, pixels) / pixels * UNIFORM) + FLT_MIN;
    for (long i = 0; i < pixels; i++)
        leverage[i] += least;
    const double total = sum_of(leverage, pixels);
    reached(leverage, pixels, total, NULL, count, count, memory->places);
    for (long i = 0; i < count; i++) {
        const long place = memory->places[i];
        memory->drawn_weights[i] =
            (float)(total / count) / leverage[place] * (whole->weights ? whole->weights[place] : 1.0f);
    }
    return sample_of(task, whole, memory->places, count, memory->drawn_weights, 1.0, memory, sample);
}

/* Steps of Newton's method over a sample, from the moment `total`; then also the inverse of the Jacobian. */
static int newton(const struct balancing *task, const struct points *sample, const double *bias, struct memory *memory,
                  double *inverse)
{
    const long landmarks = task->num_landmarks;
    float *scaling = memory->rows, *root = memory->leverage;
    double *slope = memory->slope, *right = memory->right;
    int failed = 0;
    for (long step = 0; step < task->sample_steps && !failed; step++) {
        failed |= sweep(task, sample, memory->total, memory->half, scaling, right);
        for (long i = 0; i < sample->count; i++) {
            const float d = scaling[i], w = sample->weights ? sample->weights[i] : 1.0f;
            root[i] = d * sqrtf(w / (1.0f + d * (d * sample->diagonal[i])));
        }
        failed |= nlfilter_grams(task->level, suited(task, sample, FEW_GRAMS), sample->count, 1, landmarks,
                                 sample->factor, 0, sample->stride, 1, root, root, slope);
        for (long m = 0; m < landmarks; m++) {
            slope[m * landmarks + m] += 1.0;
            right[m] += bias[m] - memory->total[m];
        }
        SETS[task->level].positive(slope, landmarks, right, step + 1 < task->sample_steps ? NULL : inverse);
        for (long m = 0; m < landmarks; m++)
            memory->total[m] += right[m];
    }
    return failed;
}

static double inner(const double *left, const double *right, long count)
{
    double sum = 0.0;
    for (long m = 0; m < count; m++)
        sum += left[m] * right[m];
    return sum;
}

/* out = a symmetric matrix (M, M) times a vector. */
static void multiply(const double *matrix, const double *vector, long count, double *out)
{
    memset(out, 0, count * sizeof(double));
    for (long m = 0; m < count; m++)
        for (long n = 0; n < count; n++)
            out[n] += vector[m] * matrix[m * count + n];
}

/* BFGS update of the inverse: _updated in scaling.py. */
static void update(double *inverse, const double *step, const double *change, long count, double *moved)
{
    const double curvature = inner(step, change, count), rho = curvature > 0.0 ? 1.0 / curvature : 0.0;
    multiply(inverse, change, count, moved);
    const double scale = rho * (1.0 + rho * inner(change, moved, count));
    for (long m = 0; m < count; m++)
        for (long n = 0; n < count; n++)
            inverse[m * count + n] += scale * step[m] * step[n] - rho * (moved[m] * step[n] + step[m] * moved[n]);
}

/* Largest magnitude of some values; infinite if one of them is NaN. */
static float largest(const float *values, long count)
{
    float most = 0.0f;
    for (long i = 0; i < count; i++)
        most = fabsf(values[i]) <= most ? most : fabsf(values[i]) > most ? fabsf(values[i]) : INFINITY;
    return most;
}

/* Largest deviation of a row sum: with rounding errors of d in `residual`, and without them, which is returned. */
static float measure(const struct balancing *task, const struct points *whole, const float *scaling,
                     struct memory *memory, float *residual, int *failed)
{
    const long landmarks = task->num_landmarks, pixels = whole->count;
    float *both = memory->half, *rows = memory->rows;
    for (long m = 0; m < landmarks; m++) {
        both[m] = (float)memory->actual[m];
        both[landmarks + m] = (float)(memory->total[m] - memory->actual[m]);
    }
    *failed |= spread(task, whole, 2, both, NULL, rows);
    for (long i = 0; i < pixels; i++) {
        rows[i] = scaling[i] * (rows[i] + whole->diagonal[i] * scaling[i]) - 1.0f;
        rows[pixels + i] *= scaling[i];
    }
    *residual = largest(rows, pixels);
    return largest(rows + pixels, pixels);
}

/* sampled_newton in scaling.py, on one image. */
static int balance_image(const struct balancing *task, long image, struct memory *memory)
{
    const long landmarks = task->num_landmarks, pixels = task->pixels;
    struct points whole = task->whole, sample = {0};
    whole.factor += image * task->step, whole.diagonal += image * pixels;
    whole.weights = whole.weights ? whole.weights + image * pixels : NULL;
    float *scaling = task->scaling + image * pixels, *residual = task->residual + image, worst = 1.0f, gain = 1.0f;
    double *total = memory->total, *actual = memory->actual, *inverse = task->inverse + image * landmarks * landmarks;
    int failed = guess(task, &whole, memory), slow = 0, done = 0;
    failed |= sweep(task, &whole, total, memory->half, scaling, actual);
    for (long sweeps = 1; sweeps <= task->most_sweeps && !done && !failed; sweeps++) {
        const int resampled = gain > RESAMPLED;
        for (long m = 0; m < landmarks; m++)
            memory->before[m] = total[m], memory->error[m] = total[m] - actual[m];
        if (resampled) {
            failed |= draw(task, &whole, scaling, memory, &sample);
            /* The error of the sample where the true moment is known is subtracted; a sample of all points has none. */
            memset(memory->change, 0, landmarks * sizeof(double));
            if (sample.count < pixels) {
                for (long i = 0; i < sample.count; i++)
                    memory->rows[i] = scaling[memory->places[i]];
                failed |= moment(task, &sample, memory->rows, memory->change);
                for (long m = 0; m < landmarks; m++)
                    memory->change[m] = actual[m] - memory->change[m];
            }
            memcpy(total, actual, landmarks * sizeof(double));
            failed |= newton(task, &sample, memory->change, memory, inverse);
        } else {
            multiply(inverse, memory->error, landmarks, memory->moved);
            for (long m = 0; m < landmarks; m++)
                total[m] -= memory->moved[m];
        }
        failed |= sweep(task, &whole, total, memory->half, scaling, actual);
        for (long m = 0; m < landmarks; m++) {
            memory->half[m] = (float)(total[m] - actual[m]);
            memory->change[m] = total[m] - actual[m] - memory->error[m];
            memory->before[m] = total[m] - memory->before[m];
        }
        if (!resampled) /* steps with a new sample are so long that the Jacobian changes along them */
            update(inverse, memory->before, memory->change, landmarks, memory->moved);
        /* As d is the root for the given total, row sums are 1 - d u . (total - actual). */
        failed |= spread(task, &sample, 1, memory->half, NULL, memory->rows);
        for (long i = 0; i < sample.count; i++)
            memory->rows[i] *= scaling[sample.count < pixels ? memory->places[i] : i];
        const float previous = worst;
        worst = largest(memory->rows, sample.count), gain = worst / previous;
        slow = gain <= 0.5f ? 0 : slow + 1;
        if (worst <= task->tolerance || slow > 1 || sweeps == task->most_sweeps)
            done = measure(task, &whole, scaling, memory, residual, &failed) <= task->tolerance || slow > 1;
        task->steps[image] = sweeps;
    }
    memcpy(task->moment + image * landmarks, actual, landmarks * sizeof(double));
    return failed;
}

static void run_balance(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct balancing *task = work->task;
    const long landmarks = task->num_landmarks, pixels = task->pixels;
    const long drawn = task->sampled_count > task->explored_count ? task->sampled_count : task->explored_count;
    const long floats = 2 * landmarks + 3 * pixels + (landmarks + 2) * drawn;
    double *doubles = malloc((landmarks + 8) * landmarks * sizeof(double) + drawn * sizeof(long));
    float *singles = malloc(floats * sizeof(float));
    (void)piece, (void)first, (void)last, (void)scratch;
    if (doubles && singles) {
        double *vectors = doubles + landmarks * landmarks;
        struct memory memory = {
            .half = singles, .rows = singles + 2 * landmarks, .leverage = singles + 2 * landmarks + 2 * pixels,
            .drawn = singles + 2 * landmarks + 3 * pixels, .slope = doubles, .total = vectors,
            .actual = vectors + landmarks, .right = vectors + 2 * landmarks, .error = vectors + 3 * landmarks,
            .before = vectors + 4 * landmarks, .change = vectors + 5 * landmarks, .moved = vectors + 6 * landmarks,
            .places = (long *)(vectors + 7 * landmarks)};
        memory.drawn_diagonal = memory.drawn + landmarks * drawn;
        memory.drawn_weights = memory.drawn_diagonal + drawn;
        if (balance_image(task, image, &memory))
            work->failed = 1;
    } else
        work->failed = 1;
    free(doubles), free(singles);
}

int nlfilter_balance(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                     long factor_step, long factor_stride, const float *diagonal, const float *weights,
                     const long *explored, long explored_count, long sampled_count, float tolerance, float *scaling,
                     double *moment, float *residual, double *inverse, long *steps)
{
    const int together = images > 1 && threads > 1; /* one image on each thread, whose data stay in its cache */
    struct balancing task = {
        .whole = {factor, diagonal, weights, factor_stride, pixels, 1.0}, .step = factor_step,
        .num_landmarks = num_landmarks, .pixels = pixels, .explored = explored, .explored_count = explored_count,
        .sampled_count = 2 * sampled_count < pixels ? sampled_count : 0, .most_sweeps = MAX_SWEEPS,
        .sample_steps = SAMPLE_STEPS, .guesses = GUESSES, .tolerance = tolerance, .most = LARGEST_ROOT,
        .scaling = scaling, .residual = residual, .moment = moment, .inverse = inverse, .steps = steps,
        .level = level, .threads = together ? 1 : threads};
    struct work work = {.run = run_balance, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .pieces = 1};
    return run_pieces(&work, together ? threads : 1);
}

/* The linear system of the gradient, for each image. */
struct system {
    const float *factor, *weight; /* (B, M, N), (B, N) */
    const double *right, *inverse; /* (B, M), (B, M, M) */
    long factor_step, factor_stride, num_landmarks, pixels, most_steps;
    double solved;
    double *solution, *left; /* (B, M), (B) */
    int level, threads;
};

/* conjugate_gradients in scaling.py, on one image; `memory` holds the residual, three vectors and one in float32. */
static int solve_image(const struct system *task, long image, double *memory, float *spare)
{
    const long landmarks = task->num_landmarks, pixels = task->pixels;
    const double *inverse = task->inverse + image * landmarks * landmarks;
    double *solution = task->solution + image * landmarks, *residual = memory, *direction = memory + landmarks;
    double *product = memory + 2 * landmarks, *preconditioned = memory + 3 * landmarks;
    float *row = spare, *out = spare + landmarks;
    int failed = 0;
    memcpy(residual, task->right + image * landmarks, landmarks * sizeof(double));
    memset(solution, 0, landmarks * sizeof(double));
    multiply(inverse, residual, landmarks, direction);
    double size = inner(residual, direction, landmarks);
    const double first = size, goal = task->solved * task->solved * first;
    for (long step = 0; step < task->most_steps && (!step || !(size <= goal)) && !failed; step++) {
        for (long m = 0; m < landmarks; m++)
            row[m] = (float)direction[m];
        failed = nlfilter_sweep(task->level, task->threads, pixels, 1, landmarks,
                                task->factor + image * task->factor_step, 0, task->factor_stride, row,
                                task->weight + image * pixels, NULL, NULL, 0.0f, out, product);
        for (long m = 0; m < landmarks; m++)
            product[m] += direction[m];
        const double bend = inner(direction, product, landmarks), before = size > DBL_MIN ? size : DBL_MIN;
        const double length = size / (bend > DBL_MIN ? bend : DBL_MIN);
        for (long m = 0; m < landmarks; m++) {
            solution[m] += length * direction[m];
            residual[m] -= length * product[m];
        }
        multiply(inverse, residual, landmarks, preconditioned);
        size = inner(residual, preconditioned, landmarks);
        for (long m = 0; m < landmarks; m++)
            direction[m] = preconditioned[m] + size / before * direction[m];
    }
    task->left[image] = size / (first > DBL_MIN ? first : DBL_MIN);
    return failed;
}

static void run_solve(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct system *task = work->task;
    double *memory = malloc(4 * task->num_landmarks * sizeof(double));
    (void)piece, (void)first, (void)last;
    if (!memory || solve_image(task, image, memory, scratch))
        work->failed = 1;
    free(memory);
}

int nlfilter_conjugate(int level, int threads, long pixels, long images, long num_landmarks, const float *factor,
                       long factor_step, long factor_stride, const float *weight, const double *right,
                       const double *inverse, long most_steps, double solved, double *solution, double *left)
{
    const int together = images > 1 && threads > 1;
    struct system task = {
        .factor = factor, .weight = weight, .right = right, .inverse = inverse, .factor_step = factor_step,
        .factor_stride = factor_stride, .num_landmarks = num_landmarks, .pixels = pixels, .most_steps = most_steps,
        .solved = solved, .solution = solution, .left = left, .level = level, .threads = together ? 1 : threads};
    struct work work = {.run = run_solve, .task = &task, .level = level, .images = images, .pixels = 1, .length = 1,
                        .pieces = 1, .floats = num_landmarks + pixels};
    return run_pieces(&work, together ? threads : 1);
}
