/* Arguments of the kernels, and the division of work among threads.
 *
 * Shapes are (rows, columns), for B images of N pixels, D features and M landmarks. Rows are contiguous; strides are
 * the distances between rows. */

#pragma once

#include <float.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "interface.h"

#define CHUNK 33024  /* maximum pixels per piece; reading long parts of each row uses memory bandwidth better */
#define LINE 64      /* pieces are multiples of this: the largest tile, and more than a cache line */
#define NEAR 196608  /* number of floats of the factor that fit the second-level cache */
#define MOST_ROWS 6
#define MOST_PIXELS 64
#define MOST_LANES 16
#define TILES 24     /* of a convolution, processed together; a multiple of all ROWS */

static inline long padded(long count, long step) { return (count + step - 1) / step * step; }

/* U = inverse_cholesky exp2(landmarks (x, 1, |x|^2)), x = features - centre; inverse_cholesky is the inverse Cholesky
 * factor of the landmark block. */
struct columns {
    const float *features, *centre; /* (D, N), (D) */
    float *factor, *norms;          /* (M, N), (N): |u|^2 before scaling, written if `limited` */
    long size, num_landmarks, pixels;
    long features_stride, factor_stride;
    long features_step, factor_step; /* from one image of a batch to the next; other arrays are contiguous */
    float floor;                     /* lower limit of the exponents */
    int limited;                     /* scale columns to norm at most 1 */
    /* Packed in blocks of ROWS rows, each stored by columns without trailing zero columns. */
    const float *landmarks, *inverse_cholesky;
    const long *depths; /* number of columns of each block of the inverse */
};

/* Gradients of the columns' inputs. The gradient of the columns is left right, or right itself if left is NULL. */
struct backward {
    struct columns columns;        /* with the inverse transposed; if triangular, blocks begin at the diagonal */
    const float *left, *right;     /* (M, R) in blocks, (R, N) */
    const float *scale, *diagonal; /* (N): scale of the columns, and the gradient of 1 - |u|^2 */
    const float *points;           /* (D + 1, M) in blocks: derivative of the exponents in the features */
    float *moved;                  /* (D, N), gradient of the features */
    long rank, right_stride, right_step;
    long tiles, rows, feature_rows; /* tiles processed together, and their rows */
    int lower;                      /* the inverse is a lower triangle */
};

struct tall_skinny {
    const float *factor; /* (M, N) */
    long factor_stride, num_landmarks, count;
    const float *rows, *images; /* (R, M), (R, N) */
    float *out;                 /* (R, N) */
    long images_stride;
    const float *scaling;  /* d, (N), or NULL */
    const float *diagonal; /* c, (N), or NULL */
    const float *weights;  /* (N), or NULL */
    float most;            /* upper limit of d */
    long factor_step, images_step; /* from one image of a batch to the next; other arrays are contiguous */
    long pixels;                   /* N */
};

/* Pixels of a sweep whose columns stay cached for the second product. */
static inline long sweep_step(long num_landmarks)
{
    const long most = NEAR / num_landmarks / 64 * 64;
    return most < 256 ? 256 : most;
}

struct grams {
    const float *factor, *scaling, *remainder; /* (M, N), (N), (N) */
    long factor_stride, factor_step, num_landmarks, count;
    long rows, step; /* padded rows and pixels of a tile of F that fits the cache */
};

/* A proposal for a pivot: how well it covers the points (S), its place in the order so far, and what it adds. */
struct proposal {
    long point;
    float *row;
    long place;
    double added;
};

static inline int compare_proposals(const void *first, const void *second)
{
    const struct proposal *a = first, *b = second;
    return a->added != b->added ? (a->added < b->added ? 1 : -1) : (a->place > b->place) - (a->place < b->place);
}

/* Number of pivots in the block that begins with number `first`. */
static inline long pivot_block(long first, long count)
{
    const long wanted = 2 * first > FIRST ? 2 * first : FIRST, most = wanted < LARGEST ? wanted : LARGEST;
    return count - first < most ? count - first : most;
}

struct pivots {
    const float *points, *draws; /* (B, D, S), (M, TRIALS) */
    long *pivots;                /* (B, M) */
    long size, used, count, num_landmarks; /* used = S; count = S padded to a multiple of LINE */
    float captured;
};

struct lloyd {
    const float *points, *start; /* (B, D, S), (B, D, M) */
    int *nearest;                /* (B, S) */
    long size, count, num_landmarks, iterations;
    float margin; /* scores closer than this, relative to their terms, are ties */
};

struct convolution {
    const float *features, *added; /* (H, W, C), and (H, W, O) or NULL */
    const float *weights, *bias;   /* transformed, (36, C, padded O), and (padded O) */
    float *out;                    /* (H, W, O) */
    long height, width, channels, outputs, padded_outputs, dilation;
    long tiles_down, tiles_across; /* of one phase of the dilation */
    float slope;                   /* of negative features */
};

struct lattice {
    const float *colours, *lattice; /* (3, N), and the nodes' values, (n, n, n, 4) */
    float *out;                     /* (3, N) */
    long nodes, pixels;
    long colours_step, colours_stride, lattice_step; /* from one image of a batch, or row, to the next */
};

/* The kernels of an instruction set, on pixels first to last; documented in the headers. */
struct set {
    long rows; /* rows in a block of a packed matrix */
    void (*columns)(const struct columns *, long first, long last, float *scratch);
    void (*backward)(const struct backward *, long first, long last, float *scratch, double *totals);
    void (*spread)(const struct tall_skinny *, long first, long last);
    void (*gather)(const struct tall_skinny *, long first, long last, double *totals);
    void (*sweep)(const struct tall_skinny *, long first, long last, float *scratch, double *totals);
    void (*grams)(const struct grams *, long first, long last, float *scratch, double *totals);
    void (*positive)(double *matrix, long count, double *right, double *inverse);
    void (*assign)(const struct lloyd *, const float *points, const float *centres, float *tile, int *nearest,
                   float *sums);
    void (*pivots)(const struct pivots *, const float *points, long *pivots, float *scratch);
    void (*convolution)(const struct convolution *, long first, long last, float *scratch);
    void (*lattice)(const struct lattice *, long first, long last);
    void (*eliminate)(double *equations, long own, long count, long stride);
    void (*substitute)(const double *equations, long own, long count, long length, long sides, double *values);
};

#pragma GCC visibility push(hidden) /* avoid clashes with other libraries */

extern const struct set SETS[];

/* Work on all pixels of a batch of images, in pieces. A free thread takes the next piece. */
struct work {
    void (*run)(struct work *, long image, long piece, long first, long last, float *scratch);
    const void *task;
    size_t floats; /* size of the scratch memory of each thread */
    int level;
    long images, pixels; /* pixels of each image */
    long length, pieces; /* pixels of a piece, and pieces per image */
    double *totals;      /* sums of each piece, or NULL */
    atomic_long next;
    atomic_int failed;
    int places;             /* threads of the pool still wanted; guarded by the pool's lock, as is the next field */
    struct work *following; /* next in the pool's list */
    atomic_int helping;     /* threads of the pool that have started on this work */
};

/* Run all pieces. Returns 0, or -1 if memory cannot be allocated. */
int run_pieces(struct work *work, int threads);

/* Divide the work into pieces of at most `most` pixels and run them. */
int divide(struct work *work, int threads, long most);

/* Divide and run work that computes `sums` sums over the pixels of each image. */
int add_up(struct work *work, int threads, long sums, double *out);

#pragma GCC visibility pop
