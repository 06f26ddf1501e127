/* Interpolation between the nodes of a lattice of colours, in tetrahedra. Defined in lattice.py. */

typedef float NAME(node) __attribute__((vector_size(16), aligned(4), may_alias)); /* the values of a node, and a zero */
typedef int NAME(order) __attribute__((vector_size(16)));

/* Some elements of two registers. */
#ifdef __clang__
#define PICK(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#else
#define PICK(x, y, ...) __builtin_shuffle(x, y, (NAME(order)){__VA_ARGS__})
#endif

INLINE INTS NAME(choose)(INTS mask, INTS yes, INTS no) { return (yes & mask) | (no & ~mask); }
INLINE FLOATS NAME(select)(INTS mask, FLOATS yes, FLOATS no)
{
    return (FLOATS)NAME(choose)(mask, (INTS)yes, (INTS)no);
}

/* For LANES colours, where the values of the first three nodes of their tetrahedra lie, and the weights of all four:
 * from the lowest node of the cell along the axis of the largest coordinate, then of the middle, then of the least. */
INLINE void NAME(locate)(const float *const colours[3], long nodes, int places[3][PIXELS], float weights[4][PIXELS],
                         long pixel)
{
    const INTS zero = {0}, highest = zero + (int)(nodes - 2);
    const INTS red = zero + (int)(4 * nodes * nodes), green = zero + (int)(4 * nodes), blue = zero + 4;
    FLOATS parts[3];
    INTS cells[3];
#pragma GCC unroll 3
    for (int c = 0; c < 3; c++) {
        const FLOATS place = NAME(clamp)(*(const FLOATS *)(colours[c] + pixel), 0.0f, 1.0f) * (float)(nodes - 1);
        const INTS cell = __builtin_convertvector(NAME(select)(place > 0.0f, place, (FLOATS)zero), INTS); /* NaN: 0 */
        cells[c] = NAME(choose)(cell > highest, highest, cell);
        parts[c] = place - __builtin_convertvector(cells[c], FLOATS);
    }
    const INTS red_leads = parts[0] >= parts[1];
    const FLOATS high = NAME(select)(red_leads, parts[0], parts[1]), low = NAME(select)(red_leads, parts[1], parts[0]);
    const INTS blue_last = high >= parts[2], blue_least = parts[2] <= low;
    const FLOATS largest = NAME(select)(blue_last, high, parts[2]), least = NAME(select)(blue_least, parts[2], low);
    const FLOATS middle = NAME(select)(blue_least, low, NAME(select)(blue_last, parts[2], high));
    const INTS first = cells[0] * red + cells[1] * green + cells[2] * blue;
    *(INTS *)(places[0] + pixel) = first;
    *(INTS *)(places[1] + pixel) = first + NAME(choose)(blue_last, NAME(choose)(red_leads, red, green), blue);
    *(INTS *)(places[2] + pixel) = first + (red + green + blue) -
                                   NAME(choose)(blue_least, blue, NAME(choose)(red_leads, green, red));
    *(FLOATS *)(weights[0] + pixel) = 1.0f - largest + 0.0f * (parts[0] + parts[1] + parts[2]); /* NaN stays NaN */
    *(FLOATS *)(weights[1] + pixel) = largest - middle;
    *(FLOATS *)(weights[2] + pixel) = middle - least;
    *(FLOATS *)(weights[3] + pixel) = least;
}

INLINE NAME(node) NAME(interpolate)(const float *lattice, long across, int places[3][PIXELS], float weights[4][PIXELS],
                                    long pixel)
{
    const float *lowest = lattice + places[0][pixel];
    return *(const NAME(node) *)lowest * weights[0][pixel] +
           *(const NAME(node) *)(lattice + places[1][pixel]) * weights[1][pixel] +
           *(const NAME(node) *)(lattice + places[2][pixel]) * weights[2][pixel] +
           *(const NAME(node) *)(lowest + across) * weights[3][pixel];
}

/* Values of pixels first to last. */
static TARGET void NAME(lattice)(const struct lattice *task, long first, long last)
{
    const long nodes = task->nodes, across = 4 * (nodes * nodes + nodes + 1); /* from a cell's lowest node to its last */
    for (long start = first; start < last; start += PIXELS) {
        const long width = last - start < PIXELS ? last - start : PIXELS;
        float edges[3][PIXELS], weights[4][PIXELS], values[3][PIXELS], *out[3];
        int places[3][PIXELS];
        const float *colours[3];
        for (int c = 0; c < 3; c++) {
            colours[c] = NAME(fetch)(task->colours + c * task->colours_stride + start, width, 0.0f, edges[c]);
            out[c] = width == PIXELS ? task->out + c * task->pixels + start : values[c];
        }
        for (long i = 0; i < PIXELS; i += LANES)
            NAME(locate)(colours, nodes, places, weights, i);
        for (long i = 0; i < PIXELS; i += 4) { /* four pixels, whose values are transposed */
            NAME(node) pixels[4];
#pragma GCC unroll 4
            for (long k = 0; k < 4; k++)
                pixels[k] = NAME(interpolate)(task->lattice, across, places, weights, i + k);
            const NAME(node) near = PICK(pixels[0], pixels[1], 0, 4, 1, 5), far = PICK(pixels[2], pixels[3], 0, 4, 1, 5);
            const NAME(node) near_last = PICK(pixels[0], pixels[1], 2, 6, 3, 7);
            const NAME(node) far_last = PICK(pixels[2], pixels[3], 2, 6, 3, 7);
            *(NAME(node) *)(out[0] + i) = PICK(near, far, 0, 1, 4, 5);
            *(NAME(node) *)(out[1] + i) = PICK(near, far, 2, 3, 6, 7);
            *(NAME(node) *)(out[2] + i) = PICK(near_last, far_last, 0, 1, 4, 5);
        }
        for (int c = 0; c < 3 && width < PIXELS; c++)
            memcpy(task->out + c * task->pixels + start, values[c], width * sizeof(float));
    }
}

#undef PICK
