/* What the kernels work on, and how work is divided among threads.
 *
 * Matrices are given as (rows, columns), B images of N pixels, D features and M landmarks. Rows are in one piece, and
 * as far apart as their stride says. */

#pragma once

#include <float.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define CHUNK 33024  /* pixels that a thread takes at a time, at most: memory likes long pieces of each row */
#define LINE 64      /* a piece is a multiple of so many: a tile, and more than a line of the cache */
#define NEAR 196608  /* numbers of the factor that stay in the second cache */
#define MOST_ROWS 6
#define MOST_PIXELS 64

static inline long padded(long count, long step) { return (count + step - 1) / step * step; }

/* U = whitening exp2(landmarks (x, 1, |x|^2)), x = features - centre. */
struct columns {
    const float *features, *centre; /* (D, N), (D) */
    float *factor, *norms;          /* (M, N), (N): |u|^2 before it is limited, if it is */
    long size, marks, pixels;
    long features_stride, factor_stride;
    long features_step, factor_step; /* from one image of a batch to the next; everything else is contiguous */
    float floor;                     /* of the exponents */
    int limited;                     /* columns longer than 1 are shortened */
    /* Matrices in blocks of ROWS rows, each stored by columns up to the last that is not zero. */
    const float *landmarks, *whitening;
    const long *depths; /* columns of each block of the whitening */
};

/* Derivatives of these, given G, that of the loss by the columns: left right, or where left is none, right itself. */
struct backward {
    struct columns columns;        /* with the whitening transposed; of a triangle, blocks begin at the diagonal */
    const float *left, *right;     /* (M, R) in blocks, (R, N) */
    const float *scale, *diagonal; /* (N), by which columns were shortened, and the derivative by 1 - |u|^2 */
    const float *points;           /* (D + 1, M) in blocks: what slopes of exponents move the features by */
    float *moved;                  /* (D, N), derivatives by the features */
    long rank, right_stride, right_step;
    long tiles, rows, feature_rows; /* how many are worked on together, and their rows */
    int lower;                      /* the whitening is a lower triangle */
};

struct thin {
    const float *factor; /* (M, N) */
    long factor_stride, marks, count;
    const float *rows, *images; /* (R, M), (R, N) */
    float *out;                 /* (R, N) */
    long images_stride;
    const float *scaling;  /* d, (N), or none */
    const float *diagonal; /* c, (N), or none */
    float most;            /* of d */
    long factor_step, images_step; /* from one image of a batch to the next; everything else is contiguous */
    long pixels;                   /* N */
};

struct grams {
    const float *factor, *scaling, *remainder; /* (M, N), (N), (N) */
    long factor_stride, factor_step, marks, count;
    long rows, step; /* of a tile of F: with rows of zeros below it, and so many pixels that it stays in the cache */
};

struct pivots {
    const float *points, *draws; /* (B, D, S), (M) */
    long *pivots;                /* (B, M) */
    long size, used, count, marks; /* S, and S in whole lines */
    float explained;
};

struct lloyd {
    const float *points, *start; /* (B, D, S), (B, D, M) */
    int *nearest;                /* (B, S) */
    long size, count, marks, iterations;
    float margin; /* of scores that count as equal, relative to the terms of their sums */
};

/* What each instruction set computes, on pixels from first to last; see the files of the same names. */
struct set {
    long rows; /* of a block of a packed matrix */
    void (*columns)(const struct columns *, long first, long last, float *scratch);
    void (*backward)(const struct backward *, long first, long last, float *scratch, double *totals);
    void (*spread)(const struct thin *, long first, long last);
    void (*gather)(const struct thin *, long first, long last, double *totals);
    void (*sweep)(const struct thin *, long first, long last, double *totals);
    void (*grams)(const struct grams *, long first, long last, float *scratch, double *totals);
    void (*assign)(const struct lloyd *, const float *points, const float *centres, float *tile, int *nearest,
                   float *sums);
    void (*pivots)(const struct pivots *, const float *points, long *pivots, float *scratch);
};

#pragma GCC visibility push(hidden) /* other libraries may have such names */

extern const struct set SETS[];

/* Work on all pixels of a batch of images, piece by piece: whichever thread is free takes the next. */
struct work {
    void (*run)(struct work *, long image, long piece, long first, long last, float *scratch);
    const void *task;
    size_t floats; /* of scratch, which every thread has for itself */
    int level;
    long images, pixels; /* of each image */
    long length, each;   /* of a piece, and how many pieces each image has */
    double *totals;      /* of each piece, where there is something to add up */
    atomic_long next;
    atomic_int failed;
};

/* Run work piece by piece; 0, or -1 where memory is short. */
int run_pieces(struct work *work, int threads);

/* The same in pieces of at most so many pixels. */
int divide(struct work *work, int threads, long most);

/* The same for work that adds up `sums` numbers for each image. */
int add_up(struct work *work, int threads, long sums, double *out);

#pragma GCC visibility pop
