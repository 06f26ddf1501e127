/* Division of work among threads. */

/* Work on all pixels, piece by piece: whichever thread is free takes the next. */
struct work {
    void (*run)(struct work *, long piece, long first, long last);
    const void *task;
    int level;
    long pixels, length; /* of a piece */
    double *totals;      /* of each piece, where there is something to add up */
    atomic_long next;
    atomic_int failed;
};

static void labour(void *argument)
{
    struct work *work = argument;
    for (;;) {
        const long piece = atomic_fetch_add(&work->next, 1), first = piece * work->length, last = first + work->length;
        if (first >= work->pixels)
            return;
        work->run(work, piece, first, last < work->pixels ? last : work->pixels);
    }
}

/* OpenMP's way to run a function on its threads, once it is known where: torch waits for work with the same threads,
 * awake for a while, so that others would find no free core. */
static void (*parallel)(void (*)(void *), void *, unsigned, unsigned);

void nlfilter_share_threads(void *gomp_parallel) { parallel = gomp_parallel; }

static void *help(void *work)
{
    labour(work);
    return NULL;
}

static int begin(struct work *work, int threads)
{
    pthread_t helpers[MOST_THREADS];
    const long pieces = padded(work->pixels, work->length) / work->length;
    int started = 0;
    if (parallel && threads > 1 && pieces > 1) {
        parallel(labour, work, threads, 0);
        return work->failed ? -1 : 0;
    }
    while (started < threads - 1 && started < pieces - 1 && started < MOST_THREADS)
        if (pthread_create(&helpers[started++], NULL, help, work)) {
            started--; /* no more threads to be had: those that there are do it */
            break;
        }
    labour(work);
    for (int i = 0; i < started; i++)
        pthread_join(helpers[i], NULL);
    return work->failed ? -1 : 0;
}

/* Four pieces for each thread, since one may be slower than another, or as many as memory likes. */
static int divide(struct work *work, int threads, long most)
{
    const long length = padded((work->pixels + 4 * threads - 1) / (4 * threads), LINE);
    work->length = length < most ? length : most;
    return begin(work, threads);
}

/* Run work that adds up `sums` numbers, and add those of the pieces in their order, so that runs agree. */
static int add_up(struct work *work, int threads, long sums, double *out)
{
    const long pieces = 4 * threads;
    work->totals = calloc(pieces * sums, sizeof(double));
    int status = work->totals ? divide(work, threads, work->pixels) : -1;
    memset(out, 0, sums * sizeof(double));
    for (long i = 0; !status && i < pieces * sums; i++)
        out[i % sums] += work->totals[i];
    free(work->totals);
    return status;
}
