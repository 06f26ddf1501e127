/* Linear systems of pixels and their eight neighbours, by nested dissection (George, "Nested Dissection of a Regular
 * Finite Element Mesh", 1973).
 *
 * The image is halved again and again by lines of pixels. The pixels of the smallest rectangles are eliminated first,
 * then the lines between pairs of rectangles, from the shortest to the longest. This leaves equations of the pixels
 * around a rectangle only, which are added to those of the next larger one. Defined in stencil.py. */

#include "tasks.h"

#define LEAF 5 /* maximum side of the smallest rectangles */
#define MOST_LEVELS 64

/* All rectangles after the same number of halvings. Their sides differ by at most 1. */
struct level {
    long height, width; /* of the largest */
    long down, across;  /* number of rectangles along each axis */
    long own, around;   /* maximum number of pixels that are eliminated, and of pixels around a rectangle */
    long length;        /* of an equation: own + around + C */
    long stride;        /* length padded for the kernel */
    double *solved;     /* equations of the eliminated pixels of each rectangle, (own, length) */
    double *remaining;  /* equations of the pixels around each rectangle, (around, around + C) */
};

struct dissection {
    const double *stencil, *right; /* (9, H, W), (C, H, W) */
    double *out;                   /* (C, H, W) */
    long height, width, sides;     /* sides = C */
    struct level *levels;
    long level, last; /* index of the level in progress, and of that of the smallest rectangles */
};

struct rectangle {
    long top, left, height, width;
    long line; /* offset of the line that halves it, or -1 */
};

static int is_halved_by_row(const struct level *level) { return level->height > level->width; }

/* A rectangle. The bits of its index tell which half it is, the highest that of the whole image. */
static struct rectangle find(const struct dissection *task, long level, long number)
{
    struct rectangle rectangle = {0, 0, task->height, task->width, -1};
    for (long k = 0;; k++) {
        long *start = &rectangle.left, *length = &rectangle.width;
        if (is_halved_by_row(task->levels + k))
            start = &rectangle.top, length = &rectangle.height;
        rectangle.line = k < task->last ? (*length - 1) / 2 : -1;
        if (k == level)
            return rectangle;
        const int second = number >> (level - 1 - k) & 1;
        *start += second ? rectangle.line + 1 : 0;
        *length = second ? *length - 1 - rectangle.line : rectangle.line;
    }
}

static long own_pixels(const struct rectangle *part, const struct level *level)
{
    if (part->line < 0)
        return part->height * part->width;
    return is_halved_by_row(level) ? part->width : part->height;
}

/* Index of a pixel among those of a rectangle that are eliminated, which come first, and those around it, row by row
 * above and below it, then on its left and right; -1 if it was eliminated before. */
static long index_of(const struct dissection *task, const struct level *level, const struct rectangle *part, long y,
                     long x)
{
    const long row = y - part->top, column = x - part->left, height = part->height, width = part->width;
    if (row >= 0 && row < height && column >= 0 && column < width) {
        if (part->line < 0)
            return row * width + column;
        if (is_halved_by_row(level))
            return row == part->line ? column : -1;
        return column == part->line ? row : -1;
    }
    const int above = part->top > 0, below = part->top + height < task->height;
    const int before = part->left > 0, after = part->left + width < task->width;
    const long own = own_pixels(part, level), length = before + width + after;
    if (row < 0)
        return own + before + column;
    if (row == height)
        return own + above * length + before + column;
    return own + (above + below) * length + (column < 0 ? 0 : before * height) + row;
}

/* List the pixels of a rectangle in the order of index_of. Returns their number. */
static long list(const struct dissection *task, const struct level *level, const struct rectangle *part, long *pixels)
{
    const long top = part->top, left = part->left, bottom = top + part->height, right = left + part->width;
    const long first = left ? left - 1 : 0, last = right < task->width ? right : right - 1, width = task->width;
    long *next = pixels;
    if (part->line < 0)
        for (long y = top; y < bottom; y++)
            for (long x = left; x < right; x++)
                *next++ = y * width + x;
    else if (is_halved_by_row(level))
        for (long x = left; x < right; x++)
            *next++ = (top + part->line) * width + x;
    else
        for (long y = top; y < bottom; y++)
            *next++ = y * width + left + part->line;
    for (long x = first; top && x <= last; x++)
        *next++ = (top - 1) * width + x;
    for (long x = first; bottom < task->height && x <= last; x++)
        *next++ = bottom * width + x;
    for (long y = top; left && y < bottom; y++)
        *next++ = y * width + left - 1;
    for (long y = top; right < width && y < bottom; y++)
        *next++ = y * width + right;
    return next - pixels;
}

/* Add the equations that remain of a half to those of the whole rectangle, at the indices of its pixels there. */
static void add_half(const struct dissection *task, const struct rectangle *whole, long half, double *equations,
                     long count, long *pixels)
{
    const struct level *level = task->levels + task->level, *smaller = level + 1;
    const struct rectangle part = find(task, task->level + 1, half);
    const long own = own_pixels(&part, smaller), around = list(task, smaller, &part, pixels) - own;
    const double *remaining = smaller->remaining + half * smaller->around * (smaller->around + task->sides);
    long *indices = pixels + own;
    for (long k = 0; k < around; k++)
        indices[k] = index_of(task, level, whole, indices[k] / task->width, indices[k] % task->width);
    for (long k = 0; k < around; k++, remaining += smaller->around + task->sides) {
        double *equation = equations + indices[k] * level->stride;
        for (long j = 0; j < around; j++)
            equation[indices[j]] += remaining[j];
        for (long c = 0; c < task->sides; c++)
            equation[count + c] += remaining[around + c];
    }
}

/* Add the coefficients between pixels to be eliminated and all others, and the right sides. */
static void add_own(const struct dissection *task, const struct rectangle *part, double *equations, long own,
                    long count, const long *pixels)
{
    const struct level *level = task->levels + task->level;
    const long area = task->height * task->width, stride = level->stride;
    for (long i = 0; i < own; i++) {
        const long pixel = pixels[i], y = pixel / task->width, x = pixel % task->width;
        for (long k = 0; k < 9; k++) {
            const long row = y + k / 3 - 1, column = x + k % 3 - 1;
            if (row < 0 || row >= task->height || column < 0 || column >= task->width)
                continue;
            const long j = index_of(task, level, part, row, column);
            if (j >= 0)
                equations[i * stride + j] = task->stencil[k * area + pixel];
            if (j >= own)
                equations[j * stride + i] = task->stencil[(8 - k) * area + row * task->width + column];
        }
        for (long c = 0; c < task->sides; c++)
            equations[i * stride + count + c] = task->right[c * area + pixel];
    }
}

static void run_eliminate(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct dissection *task = work->task;
    const struct level *level = task->levels + task->level;
    double *equations = (double *)scratch;
    long *pixels = (long *)(equations + (level->own + level->around) * level->stride);
    (void)image, (void)piece;
    for (long number = first; number < last; number++) {
        const struct rectangle part = find(task, task->level, number);
        const long own = own_pixels(&part, level), count = list(task, level, &part, pixels), stride = level->stride;
        memset(equations, 0, count * stride * sizeof(double));
        add_own(task, &part, equations, own, count, pixels);
        if (task->level < task->last)
            for (long half = 2 * number; half < 2 * number + 2; half++)
                add_half(task, &part, half, equations, count, pixels);
        SETS[work->level].eliminate(equations, own, count, stride);
        double *solved = level->solved + number * level->own * level->length;
        for (long k = 0; k < own; k++, solved += level->length)
            memcpy(solved + k, equations + k * stride + k, (count - k + task->sides) * sizeof(double));
        double *remaining = level->remaining + number * level->around * (level->around + task->sides);
        for (long k = own; k < count; k++, remaining += level->around + task->sides)
            memcpy(remaining, equations + k * stride + own, (count - own + task->sides) * sizeof(double));
    }
}

static void run_substitute(struct work *work, long image, long piece, long first, long last, float *scratch)
{
    const struct dissection *task = work->task;
    const struct level *level = task->levels + task->level;
    const long area = task->height * task->width;
    double *values = (double *)scratch;
    long *pixels = (long *)(values + task->sides * (level->own + level->around));
    (void)image, (void)piece;
    for (long number = first; number < last; number++) {
        const struct rectangle part = find(task, task->level, number);
        const long own = own_pixels(&part, level), count = list(task, level, &part, pixels);
        for (long c = 0; c < task->sides; c++)
            for (long k = own; k < count; k++)
                values[c * count + k] = task->out[c * area + pixels[k]];
        SETS[work->level].substitute(level->solved + number * level->own * level->length, own, count, level->length,
                                     task->sides, values);
        for (long c = 0; c < task->sides; c++)
            for (long k = 0; k < own; k++)
                task->out[c * area + pixels[k]] = values[c * count + k];
    }
}

/* Plan the levels of an image. Returns the number of levels. */
static long plan(const struct dissection *task, struct level *levels)
{
    struct level next = {.height = task->height, .width = task->width, .down = 1, .across = 1};
    for (long count = 1;; count++) {
        struct level *level = levels + count - 1;
        *level = next;
        const int is_last = level->height <= LEAF && level->width <= LEAF, by_row = is_halved_by_row(level);
        const long rows = level->down > 2 ? 2 : level->down - 1, columns = level->across > 2 ? 2 : level->across - 1;
        level->own = is_last ? level->height * level->width : by_row ? level->width : level->height;
        level->around = rows * (level->width + columns) + columns * level->height;
        level->length = level->own + level->around + task->sides;
        level->stride = padded(level->length, MOST_LANES);
        if (is_last)
            return count;
        *(by_row ? &next.height : &next.width) /= 2;
        *(by_row ? &next.down : &next.across) *= 2;
    }
}

static int run_level(struct dissection *task, long index, int threads, int instructions, int substitute)
{
    const struct level *level = task->levels + index;
    const long pieces = level->down * level->across, length = (pieces + 4 * threads - 1) / (4 * threads);
    const long pixels = level->own + level->around, values = pixels * (substitute ? task->sides : level->stride);
    const long below = index < task->last ? level[1].own + level[1].around : 0, listed = below > pixels ? below : pixels;
    task->level = index;
    struct work work = {.run = substitute ? run_substitute : run_eliminate, .task = task, .level = instructions,
                        .images = 1, .pixels = pieces, .length = length, .pieces = (pieces + length - 1) / length,
                        .floats = (values * sizeof(double) + listed * sizeof(long)) / sizeof(float)};
    return run_pieces(&work, threads);
}

static int solve(struct dissection *task, int threads, int instructions)
{
    int status = 0;
    for (long k = task->last; k >= 0 && !status; k--) {
        struct level *level = task->levels + k;
        const long parts = level->down * level->across;
        level->solved = malloc(parts * level->own * level->length * sizeof(double));
        level->remaining = malloc((parts * level->around * (level->around + task->sides) + 1) * sizeof(double));
        status = level->solved && level->remaining ? run_level(task, k, threads, instructions, 0) : -1;
        if (k < task->last) {
            free(level[1].remaining);
            level[1].remaining = NULL;
        }
    }
    for (long k = 0; k <= task->last && !status; k++)
        status = run_level(task, k, threads, instructions, 1);
    for (long k = 0; k <= task->last; k++) {
        free(task->levels[k].solved);
        free(task->levels[k].remaining);
    }
    return status;
}

int nlfilter_stencil(int level, int threads, long images, long height, long width, long sides, const double *stencil,
                     const double *right, double *out)
{
    const long area = height * width;
    int status = 0;
    for (long image = 0; image < images && !status; image++) {
        struct level levels[MOST_LEVELS] = {{0}};
        struct dissection task = {stencil + 9 * image * area, right + sides * image * area,
                                  out + sides * image * area, height, width, sides, levels, 0, 0};
        task.last = plan(&task, levels) - 1;
        status = solve(&task, threads, level);
    }
    return status;
}
