/* Division of work among threads: OpenMP threads shared with torch, or a separate pool. */

#include <pthread.h>

#include "tasks.h"

#define MOST_THREADS 256
#define SPINS 2000 /* reads of a counter before waiting in the kernel; 20 to 50 microseconds */

#if defined(__x86_64__)
#define PAUSE() __builtin_ia32_pause()
#else
#define PAUSE() __asm__ volatile("yield")
#endif

/* Wheels must run on any glibc that torch supports. Newer ones have another version of this function, which is the
 * same. */
#if defined(__GLIBC__) && defined(__x86_64__)
__asm__(".symver pthread_create, pthread_create@GLIBC_2.2.5");
#elif defined(__GLIBC__) && defined(__aarch64__)
__asm__(".symver pthread_create, pthread_create@GLIBC_2.17");
#endif

/* Floating-point control of this thread. With `flushed`, denormal numbers (below 1.2e-38) count as zero: on Intel
 * processors an operation on one takes about a hundred times as long as on others. */
#if defined(__x86_64__)
static uint64_t control(void) { return __builtin_ia32_stmxcsr(); }
static void set_control(uint64_t control) { __builtin_ia32_ldmxcsr((unsigned)control); }
static uint64_t flushed(uint64_t control) { return control | 0x8040; } /* results (FTZ) and operands (DAZ) */
#else
static uint64_t control(void)
{
    uint64_t control;
    __asm__ volatile("mrs %0, fpcr" : "=r"(control));
    return control;
}
static void set_control(uint64_t control) { __asm__ volatile("msr fpcr, %0" : : "r"(control)); }
static uint64_t flushed(uint64_t control) { return control | 1 << 24; } /* FZ */
#endif

static void run_worker(void *argument)
{
    struct work *work = argument;
    const uint64_t before = control();
    set_control(flushed(before));
    float *scratch = aligned_alloc(64, padded((work->floats + 1) * sizeof(float), 64));
    if (!scratch)
        work->failed = 1;
    while (scratch) {
        const long piece = atomic_fetch_add(&work->next, 1), image = piece / work->pieces;
        const long first = piece % work->pieces * work->length, last = first + work->length;
        if (image >= work->images)
            break;
        work->run(work, image, piece, first, last < work->pixels ? last : work->pixels, scratch);
    }
    free(scratch);
    set_control(before);
}

/* GOMP_parallel, once its address is known. OpenMP's threads, which torch uses too, keep spinning for a while after a
 * parallel region, so separate threads would compete with them for the cores. */
static void (*parallel)(void (*)(void *), void *, unsigned, unsigned);

void nlfilter_share_threads(void *gomp_parallel) { parallel = gomp_parallel; }

/* The pool. Its threads sleep until there is work that wants more threads. The thread that submits work takes part in
 * it, and then waits only for pool threads that have started: a thread without a core yet delays nothing. */
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t submitted = PTHREAD_COND_INITIALIZER, finished = PTHREAD_COND_INITIALIZER;
static struct work *first_work; /* head of the list of submitted work */
static int pool_size;

static void *help(void *unused)
{
    (void)unused;
    pthread_mutex_lock(&lock);
    for (;;) {
        struct work *work = first_work;
        while (work && !work->places)
            work = work->following;
        if (!work) {
            pthread_cond_wait(&submitted, &lock);
            continue;
        }
        work->places--;
        atomic_fetch_add(&work->helping, 1);
        pthread_mutex_unlock(&lock);
        run_worker(work);
        pthread_mutex_lock(&lock);
        if (atomic_fetch_sub(&work->helping, 1) == 1) /* after this, the work may no longer exist */
            pthread_cond_broadcast(&finished);
    }
    return NULL;
}

/* Reset the pool in a forked child process, which has none of its threads. */
static void forget_pool(void)
{
    lock = (pthread_mutex_t)PTHREAD_MUTEX_INITIALIZER;
    submitted = finished = (pthread_cond_t)PTHREAD_COND_INITIALIZER;
    first_work = NULL;
    pool_size = 0;
}

/* Grow the pool to `wanted` threads, or as many as can be started. */
static void grow_pool(int wanted)
{
    static int registered;
    pthread_attr_t detached;
    pthread_t thread;
    if (!registered)
        registered = !pthread_atfork(NULL, NULL, forget_pool);
    if (pthread_attr_init(&detached))
        return;
    pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED);
    while (pool_size < wanted && pool_size < MOST_THREADS && !pthread_create(&thread, &detached, help, NULL))
        pool_size++;
    pthread_attr_destroy(&detached);
}

static void run_with_pool(struct work *work, int helpers)
{
    pthread_mutex_lock(&lock);
    if (pool_size < helpers)
        grow_pool(helpers);
    work->places = helpers;
    work->following = first_work;
    first_work = work;
    pthread_mutex_unlock(&lock);
    for (int i = 0; i < helpers; i++)
        pthread_cond_signal(&submitted);
    run_worker(work);
    pthread_mutex_lock(&lock);
    struct work **link = &first_work;
    while (*link != work)
        link = &(*link)->following;
    *link = work->following;
    pthread_mutex_unlock(&lock);
    for (int i = 0; i < SPINS && atomic_load(&work->helping); i++)
        PAUSE();
    if (!atomic_load(&work->helping))
        return;
    pthread_mutex_lock(&lock);
    while (atomic_load(&work->helping))
        pthread_cond_wait(&finished, &lock);
    pthread_mutex_unlock(&lock);
}

int run_pieces(struct work *work, int threads)
{
    const long pieces = work->images * work->pieces;
    const int wanted = threads < pieces ? threads : pieces;
    if (wanted < 2)
        run_worker(work);
    else if (parallel)
        parallel(run_worker, work, threads, 0); /* a smaller team would end threads that torch will need again */
    else
        run_with_pool(work, wanted - 1);
    return work->failed ? -1 : 0;
}

/* Divide into about four pieces per thread, to balance the load, but none longer than `most`. */
static void cut(struct work *work, int threads, long most)
{
    const long wanted = (4 * threads + work->images - 1) / work->images;
    const long length = padded((work->pixels + wanted - 1) / wanted, LINE);
    work->length = length < most ? length : most;
    work->pieces = (work->pixels + work->length - 1) / work->length;
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
    work->totals = calloc(work->images * work->pieces * sums, sizeof(double));
    int status = work->totals ? run_pieces(work, threads) : -1;
    memset(out, 0, work->images * sums * sizeof(double));
    for (long piece = 0; !status && piece < work->images * work->pieces; piece++)
        for (long k = 0; k < sums; k++)
            out[piece / work->pieces * sums + k] += work->totals[piece * sums + k];
    free(work->totals);
    return status;
}
