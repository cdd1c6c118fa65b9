/* Lock-step for a stock Betaflight SITL: LD_PRELOAD of this library gives it a clock of its own.
 *
 * The program's main thread reads the clock before whatever it does. Here each reading takes
 * TICK ns, a sleep takes its length, and the clock stops at the time stamp of the last state that
 * came. There the library sends the motors once, and the thread waits for the next state. So the
 * program computes as much as between two states of a real flight, however long that takes.
 *
 * BETAFLIGHT_LOCKSTEP in the environment switches that on: its value is the time, s, after which the
 * clock stops for the first state. BETAFLIGHT_APART is added to all ports, so that several programs
 * run side by side.
 *
 * States come in a thread, sticks in another. Sticks that were sent before a state are taken over
 * before the clock goes on. In what the program reads, the stamp is constant: its own measurement
 * of the simulator's speed stays at 1.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <pthread.h>
#include <sched.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "watch.h"

enum { MOTORS = 9001, SERVOS = 9002, STICKS = 9004, STATE_SIZE = 18 * 8, MOTORS_SIZE = 68 };
static const int64_t SECOND = 1000000000, TICK = 1000; /* ns */

static int lockstep, apart;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t more_time = PTHREAD_COND_INITIALIZER;
static int64_t now = 1000000000, end; /* of the main thread, ns; where it stops */
static volatile int64_t shown;        /* now, for other threads */
static double first_stamp = -1.0;     /* of a state, s */
static int64_t first_end;

static int motors_socket = -1, sticks_socket = -1;
static struct sockaddr_in motors_to;
static char motors[MOTORS_SIZE];

static volatile int sticks_are_read;
static __thread int reads_sticks;
static __thread double stamp = -1.0; /* of the state that this thread has just read */

static ssize_t (*send_on)(int, const void *, size_t, int, const struct sockaddr *, socklen_t);
static ssize_t (*receive)(int, void *, size_t, int, struct sockaddr *, socklen_t *);

__attribute__((constructor)) static void begin(void)
{
    send_on = dlsym(RTLD_NEXT, "sendto");
    receive = dlsym(RTLD_NEXT, "recvfrom");
    const char *boot = getenv("BETAFLIGHT_LOCKSTEP"), *given = getenv("BETAFLIGHT_APART");
    lockstep = boot != NULL;
    apart = given ? atoi(given) : 0;
    shown = now;
    end = now + (boot ? atoll(boot) : 0) * SECOND;
}

static int is_main(void)
{
    static __thread int known = -1;
    if (known < 0)
        known = syscall(SYS_gettid) == getpid();
    return known;
}

static void answer_and_wait(void)
{
    int64_t before = end;
    if (motors_socket >= 0)
        send_on(motors_socket, motors, sizeof motors, 0, (struct sockaddr *)&motors_to, sizeof motors_to);
    pthread_mutex_lock(&lock);
    while (end == before)
        pthread_cond_wait(&more_time, &lock);
    pthread_mutex_unlock(&lock);
}

static void spend(int64_t time)
{
    while (now + time > end) {
        time -= end - now;
        shown = now = end;
        answer_and_wait();
    }
    shown = now += time;
}

static void go_on_to(double to)
{
    int unread = 0;
    while (sticks_socket >= 0 && (sticks_are_read || (!ioctl(sticks_socket, FIONREAD, &unread) && unread)))
        sched_yield();
    pthread_mutex_lock(&lock);
    if (first_stamp < 0.0) {
        first_stamp = to;
        first_end = end;
    }
    int64_t wanted = first_end + (int64_t)((to - first_stamp) * SECOND + 0.5);
    end = wanted > end ? wanted : end + 1; /* the same time again: motors alone */
    pthread_mutex_unlock(&lock);
    pthread_cond_signal(&more_time);
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (!lockstep || clock != CLOCK_MONOTONIC)
        return (int)syscall(SYS_clock_gettime, clock, time);
    int mine = is_main();
    if (mine)
        spend(TICK);
    int64_t read = mine ? now : shown;
    time->tv_sec = read / SECOND;
    time->tv_nsec = read % SECOND;
    return 0;
}

int nanosleep(const struct timespec *time, struct timespec *left)
{
    if (!lockstep || !is_main())
        return (int)syscall(SYS_nanosleep, time, left);
    spend(time->tv_sec * SECOND + time->tv_nsec);
    return 0;
}

/* The port of an address; 0 of other families. The address in `moved` has it `apart` higher. */
static int port_of(const struct sockaddr *address, socklen_t size, struct sockaddr_in *moved)
{
    if (!address || address->sa_family != AF_INET || size != sizeof *moved)
        return 0;
    memcpy(moved, address, sizeof *moved);
    int port = ntohs(moved->sin_port);
    moved->sin_port = htons(port + apart);
    return port;
}

int bind(int socket, const struct sockaddr *address, socklen_t size)
{
    struct sockaddr_in moved;
    int port = port_of(address, size, &moved);
    if (port == STICKS)
        sticks_socket = socket;
    return (int)syscall(SYS_bind, socket, port ? (const void *)&moved : address, size);
}

ssize_t sendto(int socket, const void *data, size_t size, int flags, const struct sockaddr *address, socklen_t length)
{
    struct sockaddr_in moved;
    int port = port_of(address, length, &moved);
    if (lockstep && port == SERVOS) /* nobody hears them */
        return (ssize_t)size;
    if (!lockstep || port != MOTORS || size != MOTORS_SIZE)
        return send_on(socket, data, size, flags, port ? (const void *)&moved : address, length);
    pthread_mutex_lock(&lock);
    memcpy(motors, data, size);
    motors_socket = socket;
    motors_to = moved;
    pthread_mutex_unlock(&lock);
    return (ssize_t)size;
}

ssize_t recvfrom(int socket, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *length)
{
    if (lockstep && socket == sticks_socket)
        reads_sticks = sticks_are_read = 1;
    ssize_t got = receive(socket, data, size, flags, from, length);
    if (lockstep && got == STATE_SIZE && socket != sticks_socket) {
        const double constant = 1.0;
        memcpy(&stamp, data, sizeof stamp);
        memcpy(data, &constant, sizeof constant);
    }
    return got;
}

int select(int count, fd_set *reads, fd_set *writes, fd_set *errors, struct timeval *timeout)
{
    if (reads_sticks) /* it has taken over the last sticks */
        sticks_are_read = 0;
    if (stamp >= 0.0) { /* it has taken over the last state */
        go_on_to(stamp);
        stamp = -1.0;
        watch(count - 1); /* its one socket */
    }
    return (int)syscall(SYS_select, count, reads, writes, errors, timeout);
}
