/* A clock that runs FASTER times as fast, for the simulator of a planner: its real-time threads then take less time.
 *
 *     cc -shared -fPIC -o faster_clock.so faster_clock.c -ldl
 *     FASTER=8 LD_PRELOAD=$PWD/faster_clock.so linuxcnc machine.ini
 *
 * All processes count from the boot of the machine, so they agree about the time.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <stdlib.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>

static double speed(void) {
    static double value;
    if (value == 0) value = getenv("FASTER") ? atof(getenv("FASTER")) : 1;
    return value;
}

static double seconds(const struct timespec *t) { return t->tv_sec + 1e-9 * t->tv_nsec; }

static struct timespec stamp(double s) {
    struct timespec t = {(time_t)s, (long)(1e9 * (s - (time_t)s))};
    return t;
}

static int real_time(clockid_t id, struct timespec *t) {
    static int (*next)(clockid_t, struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "clock_gettime");
    return next(id, t);
}

static int real_sleep(double s) {
    static int (*next)(clockid_t, int, const struct timespec *, struct timespec *);
    if (!next) next = dlsym(RTLD_NEXT, "clock_nanosleep");
    struct timespec t = stamp(s > 0 ? s : 0);
    return next(CLOCK_MONOTONIC, 0, &t, NULL);
}

int clock_gettime(clockid_t id, struct timespec *t) {
    int code = real_time(id, t);
    if (code == 0 && id == CLOCK_MONOTONIC) *t = stamp(speed() * seconds(t));
    return code;
}

int clock_nanosleep(clockid_t id, int flags, const struct timespec *t, struct timespec *left) {
    (void)left;
    double s = seconds(t);
    if (flags & TIMER_ABSTIME) {
        struct timespec now;
        clock_gettime(id, &now);
        s -= seconds(&now);
    }
    return real_sleep(s / (id == CLOCK_MONOTONIC || !(flags & TIMER_ABSTIME) ? speed() : 1));
}

int nanosleep(const struct timespec *t, struct timespec *left) {
    (void)left;
    int code = real_sleep(seconds(t) / speed());
    if (code) errno = code;
    return code ? -1 : 0;
}

int usleep(useconds_t us) { return real_sleep(1e-6 * us / speed()) ? -1 : 0; }

int select(int n, fd_set *r, fd_set *w, fd_set *e, struct timeval *t) {
    static int (*next)(int, fd_set *, fd_set *, fd_set *, struct timeval *);
    if (!next) next = dlsym(RTLD_NEXT, "select");
    if (!t) return next(n, r, w, e, t);
    double s = (t->tv_sec + 1e-6 * t->tv_usec) / speed();
    struct timeval shorter = {(time_t)s, (suseconds_t)(1e6 * (s - (time_t)s))};
    return next(n, r, w, e, &shorter);
}
