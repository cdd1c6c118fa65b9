/* Lock-step for a stock Crazyflie SITL: LD_PRELOAD of this library gives it a clock of its own.
 *
 * The program runs FreeRTOS on POSIX: each task is a thread, one of them runs at a time, and a timer
 * of 1 kHz sends the signal of the tick. Here there is no timer. The scheduler resumes its idle task
 * when all other tasks wait; that thread then runs the loop below in place of the idle task. The loop
 * collects datagrams until a reading of the IMU, calls the handler of the tick, and sends the newest
 * motors, or an empty datagram. So each reading is followed by 1 ms of the program's clock, however
 * long that takes. Until it has a socket, the program's clock goes on by itself.
 *
 * Datagrams that were collected are what the program's task of the link then reads.
 *
 * The firmware takes a tick for 32 bits where FreeRTOS has 64: a variable on the stack of its loop
 * has upper bits that nothing sets, and in some runs it never begins. So a task begins on zeros. This
 * alone is what the library does where ROTORGRAM_OWN_CLOCK is set.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <errno.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#include "watch.h"

enum { SIMULATED = 0x90, MASK = 0xF3, MOTORS_SIZE = 9, SLOTS = 64, SIZE = 64 };
static const long SECOND = 1000000000, TICK = 1000000; /* ns */

static long now; /* ns */
static void (*tick)(int);
static pthread_t threads[2], idle; /* the last two that were created */
static int started;
static int own_clock; /* whether the program keeps its own clock */

static int link_socket = -1;
static struct sockaddr_in simulator;
static char datagrams[SLOTS][SIZE];
static size_t sizes[SLOTS];
static unsigned first, count;
static char motors[MOTORS_SIZE];
static size_t motors_size; /* 0: none since the last answer */

static int (*create)(pthread_t *, const pthread_attr_t *, void *(*)(void *), void *);
static int (*set_mask)(int, const sigset_t *, sigset_t *);
static int (*set_action)(int, const struct sigaction *, struct sigaction *);
static int (*wait_for)(struct pollfd *, nfds_t, int);
static ssize_t (*send_on)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
static ssize_t (*receive)(int, void *, size_t, int, struct sockaddr *, socklen_t *);

__attribute__((constructor)) static void begin(void)
{
    own_clock = getenv("ROTORGRAM_OWN_CLOCK") != NULL;
    create = dlsym(RTLD_NEXT, "pthread_create");
    set_mask = dlsym(RTLD_NEXT, "pthread_sigmask");
    set_action = dlsym(RTLD_NEXT, "sigaction");
    wait_for = dlsym(RTLD_NEXT, "poll");
    send_on = dlsym(RTLD_NEXT, "sendto");
    receive = dlsym(RTLD_NEXT, "recvfrom");
}

/* The first to send is the simulator. */
static int is_simulator(const struct sockaddr_in *from)
{
    if (!simulator.sin_port)
        simulator = *from;
    return from->sin_port == simulator.sin_port && from->sin_addr.s_addr == simulator.sin_addr.s_addr;
}

/* Take datagrams from the socket until a reading of the IMU. */
static void collect(void)
{
    int is_imu = 0;
    while (!is_imu) {
        char datagram[SIZE];
        struct sockaddr_in from;
        socklen_t length = sizeof from;
        watch(link_socket);
        ssize_t got = receive(link_socket, datagram, SIZE, 0, (struct sockaddr *)&from, &length);
        if (got < 0 && errno != EINTR)
            _exit(1);
        if (got <= 0 || count == SLOTS || !is_simulator(&from))
            continue;
        unsigned slot = (first + count++) % SLOTS;
        memcpy(datagrams[slot], datagram, got);
        sizes[slot] = got;
        is_imu = got > 1 && (datagram[0] & MASK) == SIMULATED && datagram[1] == 0;
    }
}

static void run_idle_task(void)
{
    for (;;) {
        if (link_socket >= 0)
            collect();
        now += TICK;
        tick(SIGALRM); /* returns when all other tasks wait */
        if (simulator.sin_port)
            send_on(link_socket, motors, motors_size, 0, (struct sockaddr *)&simulator, sizeof simulator);
        motors_size = 0;
    }
}

int pthread_create(pthread_t *thread, const pthread_attr_t *attributes, void *(*run)(void *), void *argument)
{
    int status = create(thread, attributes, run, argument);
    if (!started) {
        threads[0] = threads[1];
        threads[1] = *thread;
    }
    return status;
}

/* The scheduler starts: it has just created its idle task and the task of its timers. */
int setitimer(__itimer_which_t which, const struct itimerval *value, struct itimerval *old)
{
    idle = threads[0];
    started = 1;
    return own_clock ? (int)syscall(SYS_setitimer, which, value, old) : 0;
}

int sigaction(int number, const struct sigaction *action, struct sigaction *old)
{
    if (number != SIGALRM || own_clock)
        return set_action(number, action, old);
    tick = action->sa_handler;
    return 0;
}

/* Called last, so that its array lies where the frame of the task will be. */
static int __attribute__((noinline)) with_clear_stack(int status)
{
    volatile char below[4096];
    for (unsigned i = 0; i < sizeof below; i++)
        below[i] = 0;
    return status;
}

/* The first thing that a task does is to take signals. */
int pthread_sigmask(int how, const sigset_t *signals, sigset_t *old)
{
    static __thread int begun;
    int status = set_mask(how, signals, old);
    if (!started || begun || how != SIG_UNBLOCK)
        return status;
    begun = 1;
    if (!own_clock && pthread_equal(pthread_self(), idle))
        run_idle_task();
    return with_clear_stack(status);
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (clock != CLOCK_MONOTONIC || own_clock)
        return (int)syscall(SYS_clock_gettime, clock, time);
    time->tv_sec = now / SECOND;
    time->tv_nsec = now % SECOND;
    return 0;
}

int bind(int socket, const struct sockaddr *address, socklen_t size)
{
    if (!own_clock)
        link_socket = socket;
    return (int)syscall(SYS_bind, socket, address, size);
}

int poll(struct pollfd *sockets, nfds_t many, int timeout)
{
    if (sockets->fd != link_socket)
        return wait_for(sockets, many, timeout);
    sockets->revents = POLLIN;
    if (count)
        return 1;
    errno = EINTR; /* as if a tick had come: the task waits for 1 ms */
    return -1;
}

ssize_t sendto(int socket, const void *data, size_t size, int flags, const struct sockaddr *address, socklen_t length)
{
    if (socket != link_socket || size != MOTORS_SIZE || (*(const char *)data & MASK) != SIMULATED)
        return send_on(socket, data, size, flags, address, length);
    memcpy(motors, data, size);
    motors_size = size;
    return (ssize_t)size;
}

ssize_t recvfrom(int socket, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
    if (socket != link_socket || !count)
        return receive(socket, data, size, flags, from, length);
    size_t got = sizes[first] < size ? sizes[first] : size;
    memcpy(data, datagrams[first], got);
    memcpy(from, &simulator, sizeof simulator);
    *length = sizeof simulator;
    first = (first + 1) % SLOTS;
    count--;
    return (ssize_t)got;
}
