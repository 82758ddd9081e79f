/* A clock for user-mode-linux that is nearly independent of the load on the machine that it runs on.
 *
 *     cc -O2 -shared -fPIC -o guest_clock.so guest_clock.c
 *     UML_CLOCK_SLOWED=50 UML_CLOCK_SLOWED_FROM=FILE LD_PRELOAD=./guest_clock.so linux.uml ...
 *
 * When all processes in the guest are idle, its time jumps to the next timer at once. As soon as FILE exists (after booting),
 * time passes UML_CLOCK_SLOWED times as slowly as the machine's while the guest computes. Until then it passes eight times
 * as fast, because the kernel measures its RAID routines for a second and a half of the clock. If a processor is taken away
 * for 100 ms, it is only 2 ms for the guest, and no time is spent on waiting. To the guest's kernel and to every process in
 * it, the computer seems to be a fast one. Without the variables, time is the machine's.
 *
 * The kernel has one timer (timer_settime), one clock (CLOCK_MONOTONIC) and one place at which it is idle (sigsuspend).
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

static const int64_t SECOND_NS = 1000000000;
static const int64_t BOOTING = 8;

static int64_t slowed;        /* 0: the machine's own time */
static int64_t quickened = 1; /* machine_ns / guest_ns is slowed / quickened */
static int64_t slowed_later;
static const char *slowed_from;
static int64_t guest_base_ns, machine_base_ns; /* the same instant on both clocks */
static int64_t expiry_ns, every_ns;            /* the kernel's timer on the guest's clock; 0: none */

static int (*real_clock_gettime)(clockid_t, struct timespec *);
static int (*real_timer_settime)(timer_t, int, const struct itimerspec *, struct itimerspec *);
static int (*real_timer_gettime)(timer_t, struct itimerspec *);
static int (*real_sigsuspend)(const sigset_t *);
static timer_t timer;

static int64_t ns_of(const struct timespec *time) { return time->tv_sec * SECOND_NS + time->tv_nsec; }
static struct timespec timespec_of(int64_t ns) { return (struct timespec){ns / SECOND_NS, ns % SECOND_NS}; }

static int64_t machine_ns(void)
{
    struct timespec now;
    real_clock_gettime(CLOCK_MONOTONIC, &now);
    return ns_of(&now);
}

static int64_t guest_ns(void) { return guest_base_ns + (machine_ns() - machine_base_ns) * quickened / slowed; }

__attribute__((constructor)) static void begin(void)
{
    real_clock_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    real_timer_settime = dlsym(RTLD_NEXT, "timer_settime");
    real_timer_gettime = dlsym(RTLD_NEXT, "timer_gettime");
    real_sigsuspend = dlsym(RTLD_NEXT, "sigsuspend");
    const char *text = getenv("UML_CLOCK_SLOWED");
    slowed_later = text ? atoi(text) : 0;
    slowed_from = getenv("UML_CLOCK_SLOWED_FROM");
    slowed = slowed_later > 0 && slowed_from;
    quickened = slowed ? BOOTING : 1;
    guest_base_ns = machine_base_ns = machine_ns();
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (!slowed || clock != CLOCK_MONOTONIC)
        return real_clock_gettime(clock, time);
    *time = timespec_of(guest_ns());
    return 0;
}

/* Sets the machine's timer to the time left on the guest's clock; disarms it if the guest has none. */
static int arm(void)
{
    int64_t left_ns = 0;
    if (expiry_ns) {
        left_ns = (expiry_ns - guest_ns()) * slowed / quickened;
        if (left_ns < 1)
            left_ns = 1; /* zero would disarm */
    }
    struct itimerspec each = {timespec_of(every_ns * slowed / quickened), timespec_of(left_ns)};
    return real_timer_settime(timer, 0, &each, NULL);
}

/* Called not only when all are idle; otherwise a command that computes from its start would run in accelerated time. */
static void slow_down_when_booted(void)
{
    if (!slowed_from || access(slowed_from, F_OK) != 0)
        return;
    int64_t now_ns = guest_ns();
    machine_base_ns = machine_ns();
    guest_base_ns = now_ns;
    slowed = slowed_later;
    quickened = 1;
    slowed_from = NULL;
}

int timer_settime(timer_t which, int flags, const struct itimerspec *set, struct itimerspec *old)
{
    if (!slowed || flags)
        return real_timer_settime(which, flags, set, old);
    slow_down_when_booted();
    timer = which;
    every_ns = ns_of(&set->it_interval);
    expiry_ns = ns_of(&set->it_value);
    if (expiry_ns)
        expiry_ns += guest_ns();
    return arm();
}

/* Advances to the next future expiry; a one-shot timer that has expired has none. */
static void count_expired(void)
{
    int64_t now_ns = guest_ns();
    if (!expiry_ns || expiry_ns > now_ns)
        return;
    expiry_ns = every_ns ? expiry_ns + ((now_ns - expiry_ns) / every_ns + 1) * every_ns : 0;
}

int timer_gettime(timer_t which, struct itimerspec *left)
{
    if (!slowed)
        return real_timer_gettime(which, left);
    count_expired();
    left->it_interval = timespec_of(every_ns);
    left->it_value = timespec_of(expiry_ns ? expiry_ns - guest_ns() : 0);
    return 0;
}

int sigsuspend(const sigset_t *mask)
{
    if (slowed)
        slow_down_when_booted();
    if (slowed && expiry_ns) {
        int64_t left_ns = expiry_ns - guest_ns();
        if (left_ns > 0)
            guest_base_ns += left_ns;
        count_expired();
        arm();
        raise(SIGALRM); /* blocked here; `mask` lets it through */
    }
    return real_sigsuspend(mask);
}
