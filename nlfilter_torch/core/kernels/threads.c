/* Division of work among threads. */

#include <pthread.h>

#include "tasks.h"

#define MOST_THREADS 256

static void run_worker(void *argument)
{
    struct work *work = argument;
    float *scratch = aligned_alloc(64, padded((work->floats + 1) * sizeof(float), 64));
    if (!scratch)
        work->failed = 1;
    while (scratch) {
        const long piece = atomic_fetch_add(&work->next, 1), image = piece / work->each;
        const long first = piece % work->each * work->length, last = first + work->length;
        if (image >= work->images)
            break;
        work->run(work, image, piece, first, last < work->pixels ? last : work->pixels, scratch);
    }
    free(scratch);
}

/* GOMP_parallel, once its address is known. OpenMP's threads, which torch uses too, keep spinning for a while after a
 * parallel region, so threads of our own would compete with them for the cores. */
static void (*parallel)(void (*)(void *), void *, unsigned, unsigned);

void nlfilter_share_threads(void *gomp_parallel) { parallel = gomp_parallel; }

static void *start_helper(void *work)
{
    run_worker(work);
    return NULL;
}

int run_pieces(struct work *work, int threads)
{
    pthread_t helpers[MOST_THREADS];
    const long pieces = work->images * work->each;
    int started = 0;
    if (parallel && threads > 1 && pieces > 1) {
        parallel(run_worker, work, threads, 0);
        return work->failed ? -1 : 0;
    }
    while (started < threads - 1 && started < pieces - 1 && started < MOST_THREADS)
        if (pthread_create(&helpers[started++], NULL, start_helper, work)) {
            started--; /* no more threads available; continue with those already started */
            break;
        }
    run_worker(work);
    for (int i = 0; i < started; i++)
        pthread_join(helpers[i], NULL);
    return work->failed ? -1 : 0;
}

/* About four pieces per thread, to balance the load, but none longer than `most`. */
static void cut(struct work *work, int threads, long most)
{
    const long wanted = (4 * threads + work->images - 1) / work->images;
    const long length = padded((work->pixels + wanted - 1) / wanted, LINE);
    work->length = length < most ? length : most;
    work->each = (work->pixels + work->length - 1) / work->length;
}

int divide(struct work *work, int threads, long most)
{
    cut(work, threads, most);
    return run_pieces(work, threads);
}

/* The sums of the pieces are added in order, so that results are reproducible. */
int add_up(struct work *work, int threads, long sums, double *out)
{
    cut(work, threads, work->pixels);
    work->totals = calloc(work->images * work->each * sums, sizeof(double));
    int status = work->totals ? run_pieces(work, threads) : -1;
    memset(out, 0, work->images * sums * sizeof(double));
    for (long piece = 0; !status && piece < work->images * work->each; piece++)
        for (long k = 0; k < sums; k++)
            out[piece / work->each * sums + k] += work->totals[piece * sums + k];
    free(work->totals);
    return status;
}
