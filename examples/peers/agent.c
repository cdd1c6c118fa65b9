/* An agent for rotorgram's text protocol (docs/protocol.md): a UDP server that flies the episodes of
 * one simulator with a PD law on the elevation error, its rate and the thrust, and then closes.
 *
 *     gcc -std=c99 -O2 -Wall -Wextra -Wpedantic -Werror -o agent agent.c -lm
 *     ./agent [PORT [EPISODES [SEED [SECONDS]]]]       in one terminal
 *     rotorgram sim --codec text                       in another
 *
 * With -DPOLICY='"rotorgram_policy.h"' it flies the policy that `rotorgram export --to c` wrote to that
 * file (docs/export.md) in place of the PD law.
 *
 * Episode i, counted from 1, is reset with SEED + i - 1. It waits SECONDS for a legal datagram.
 * Exit status: 0 all episodes flown, 1 the simulator went away or none came, 2 wrong arguments. */

#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <ctype.h>
#include <errno.h>
#include <inttypes.h>
#include <math.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { MAX_BYTES = 1200 };

#ifdef POLICY
#include POLICY
#define LAST "last |observation[0]| %.6f"
enum {
    OBSERVATIONS = ROTORGRAM_OBSERVATIONS,
    ACTIONS = ROTORGRAM_ACTIONS,
    TELEMETRY = ROTORGRAM_TELEMETRY
};

#ifdef ROTORGRAM_STATE
static rotorgram_policy_state state; /* what the policy remembers of the episode */
#endif

static void begin(void)
{
#ifdef ROTORGRAM_STATE
    rotorgram_policy_init(&state);
#endif
}

/* Text has the digits of a double; observations and actions are floats on both sides. */
static void act(const double *values, double *action)
{
    float observation[OBSERVATIONS], chosen[ACTIONS];
    for (int i = 0; i < OBSERVATIONS; i++)
        observation[i] = (float)values[i];
#ifdef ROTORGRAM_STATE
    rotorgram_policy(&state, observation, chosen);
#else
    rotorgram_policy(observation, chosen);
#endif
    for (int i = 0; i < ACTIONS; i++)
        action[i] = chosen[i];
}
#else
/* Of rotorgram/Elevation-v0: E, its rate, thrust / hover - 1; in the paper's frame X, Y, Z, three
 * angles, three velocities and three body rates; F1 to F4, the goal X, Y, Z, and E as the metric. */
#define LAST "last |E| %.6f m"
enum { OBSERVATIONS = 3, ACTIONS = 1, TELEMETRY = 20 };

static void begin(void)
{
}

static void act(const double *values, double *action)
{
    double error = values[0], rate = values[1], thrust = values[2];
    action[0] = fmax(-1, fmin(1, 9 * error + 6 * rate - 9.8 * thrust));
}
#endif

typedef struct {
    uint64_t sequence;
    bool close, terminated, truncated;
    double reward, values[OBSERVATIONS + TELEMETRY];
} Message;

static int udp;
static struct sockaddr_in simulator; /* the one that this agent is pinned to, once `begun` */
static char answer[MAX_BYTES];       /* the last one, which every repeat gets again */

/* Parsing. Each function reads one piece of the grammar at *at and goes behind it, if it is there. */

static bool one_of(const char **at, const char *set)
{
    bool there = **at && strchr(set, **at);
    *at += there;
    return there;
}

static bool digits(const char **at)
{
    const char *first = *at;
    while (isdigit((unsigned char)**at))
        ++*at;
    return *at > first;
}

static bool whole(const char **at, uint64_t *out)
{
    const char *first = *at;
    if (!digits(at) || *at - first > 20 || (*first == '0' && *at - first > 1))
        return false; /* no leading zeros: a number is written in one way */
    errno = 0;
    *out = strtoull(first, NULL, 10);
    return errno == 0; /* else it is 2^64 or more */
}

static bool number(const char **at, double *out)
{
    const char *first = *at;
    one_of(at, "+-");
    if (digits(at)) {
        if (one_of(at, "."))
            digits(at);
    } else if (!one_of(at, ".") || !digits(at)) {
        return false;
    }
    if (one_of(at, "eE")) {
        one_of(at, "+-");
        if (!digits(at))
            return false;
    }
    *out = strtod(first, NULL);
    return isfinite(*out); /* 1e999 is not */
}

static bool flag(const char **at, bool *out)
{
    *out = **at == '1';
    return one_of(at, "01");
}

/* Whether a datagram of so many bytes, in a buffer of at least one more, is a legal line. */
static bool parse(char *line, ssize_t length, Message *m)
{
    const char *at = line;
    if (length > MAX_BYTES)
        return false;
    length -= length > 0 && line[length - 1] == '\n';
    length -= length > 0 && line[length - 1] == '\r';
    line[length] = 0;
    if (!whole(&at, &m->sequence) || !one_of(&at, ","))
        return false;
    m->close = strcmp(at, "close") == 0;
    if (m->close)
        return at + strlen(at) == line + length;
    if (!number(&at, &m->reward) || !one_of(&at, ",") || !flag(&at, &m->terminated)
        || !one_of(&at, ",") || !flag(&at, &m->truncated))
        return false;
    for (int i = 0; i < OBSERVATIONS + TELEMETRY; i++)
        if (!one_of(&at, ",") || !number(&at, &m->values[i]))
            return false;
    return at == line + length;
}

/* The socket. */

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* The length of the next datagram, or -1 if none comes before the deadline. */
static ssize_t receive(char *line, struct sockaddr_in *from, double deadline)
{
    for (double left; (left = deadline - now()) > 0;) {
        struct pollfd wanted = {.fd = udp, .events = POLLIN};
        socklen_t size = sizeof *from;
        ssize_t length = -1;
        if (poll(&wanted, 1, (int)ceil(1e3 * left)) > 0)
            length = recvfrom(udp, line, MAX_BYTES + 1, 0, (struct sockaddr *)from, &size);
        if (length >= 0)
            return length;
    }
    return -1;
}

/* What cannot be sent counts as lost: the simulator asks again. */
static void reply(const struct sockaddr_in *to, const char *line)
{
    (void)!sendto(udp, line, strlen(line), 0, (const struct sockaddr *)to, sizeof *to);
}

static bool from_simulator(const struct sockaddr_in *from)
{
    return from->sin_addr.s_addr == simulator.sin_addr.s_addr && from->sin_port == simulator.sin_port;
}

/* The flight: all episodes, then the Close that is sent. Returns the exit status. */
static int fly(uint64_t episodes, uint64_t seed, double patience)
{
    char line[MAX_BYTES + 2];
    Message m = {0};
    struct sockaddr_in from;
    bool begun = false, fresh = false, binary = false; /* fresh: the last answer was a reset */
    uint64_t last = 0, episode = 0, steps = 0, dropped = 0;
    double total = 0, deadline = now() + patience;

    while (episode < episodes) {
        ssize_t length = receive(line, &from, deadline);
        if (length < 0) {
            fprintf(stderr, "%s within %g s; datagrams dropped: %" PRIu64 "%s\n",
                    begun ? "nothing new came from the simulator" : "no text simulator came",
                    patience, dropped, binary ? ", binary ones too: start sim --codec text" : "");
            return 1;
        }
        bool legal = parse(line, length, &m);
        bool ours = legal && begun && from_simulator(&from);
        bool repeat = ours && m.sequence == last;
        bool next = legal && (!begun || (ours && last != UINT64_MAX && m.sequence == last + 1));
        if (ours && m.close && (repeat || next)) {
            snprintf(answer, sizeof answer, "%" PRIu64 ",close", last);
            reply(&simulator, answer);
            fprintf(stderr, "the simulator closed in episode %" PRIu64 "\n", episode + 1);
            return 1;
        }
        if (repeat && !m.close) {
            reply(&simulator, answer);
            continue;
        }
        bool wrong_start = next && fresh && (m.reward != 0 || m.terminated || m.truncated);
        if (!next || m.close || wrong_start) {
            dropped++;
            binary = binary || (length > 0 && (unsigned char)line[0] == 0xa7);
            if (legal && begun && !ours && !m.close) { /* another simulator: no slot is free */
                snprintf(line, sizeof line, "%" PRIu64 ",close", m.sequence);
                reply(&from, line);
            }
            continue;
        }

        bool done = !begun; /* the simulator's own start has a seed of its own: reset it with ours */
        if (begun && !fresh) {
            steps++;
            total += m.reward;
            done = m.terminated || m.truncated;
            if (done) {
                printf("episode %" PRIu64 ": %" PRIu64 " steps, return %.12g, " LAST ", %s\n",
                       ++episode, steps, total, fabs(m.values[0]),
                       m.terminated ? "terminated" : "truncated");
                fflush(stdout);
            }
        }
        if (episode == episodes) {
            snprintf(answer, sizeof answer, "%" PRIu64 ",close", m.sequence);
        } else if (done) {
            snprintf(answer, sizeof answer, "%" PRIu64 ",reset,%" PRIu64, m.sequence, seed + episode);
            steps = 0;
            total = 0;
            begin();
        } else {
            double action[ACTIONS];
            int end = snprintf(answer, sizeof answer, "%" PRIu64, m.sequence);
            act(m.values, action);
            for (int i = 0; i < ACTIONS && end < MAX_BYTES; i++)
                end += snprintf(answer + end, sizeof answer - (size_t)end, ",%.17g", action[i]);
        }
        simulator = from;
        begun = true;
        fresh = done;
        last = m.sequence;
        deadline = now() + patience;
        reply(&simulator, answer);
    }

    /* The Close is repeated every 25 ms until it is answered, for 0.25 s at most. */
    for (double end = now() + 0.25, due = now() + 0.025; now() < end;) {
        ssize_t length = receive(line, &from, fmin(due, end));
        bool heard = length >= 0 && parse(line, length, &m) && from_simulator(&from);
        if (heard && m.close)
            break;
        if (length < 0 || (heard && m.sequence == last)) {
            reply(&simulator, answer);
            due = now() + 0.025;
        }
    }
    return 0;
}

static uint64_t argument(int argc, char **argv, int i, const char *name, uint64_t least,
                         uint64_t most, uint64_t otherwise)
{
    const char *at = i < argc ? argv[i] : "";
    uint64_t value = otherwise;
    if (i < argc && (!whole(&at, &value) || *at || value < least || value > most)) {
        fprintf(stderr, "%s: expected a whole number, %" PRIu64 " to %" PRIu64 ", got '%s'\n", name,
                least, most, argv[i]);
        exit(2);
    }
    return value;
}

int main(int argc, char **argv)
{
    uint64_t port = argument(argc, argv, 1, "port", 0, 65535, 8001);
    uint64_t episodes = argument(argc, argv, 2, "episodes", 1, 1000000, 3);
    uint64_t seed = argument(argc, argv, 3, "seed", 0, UINT64_MAX, 0);
    uint64_t seconds = argument(argc, argv, 4, "seconds", 1, 1000000, 30);
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK); /* text cannot be sealed: this machine alone */

    socklen_t size = sizeof here;
    udp = socket(AF_INET, SOCK_DGRAM, 0);
    if (udp < 0 || bind(udp, (struct sockaddr *)&here, size)
        || getsockname(udp, (struct sockaddr *)&here, &size)) {
        fprintf(stderr, "127.0.0.1:%" PRIu64 ": %s\n", port, strerror(errno));
        return 1;
    }
    printf("waiting at 127.0.0.1:%d\n", ntohs(here.sin_port)); /* port 0 took a free one */
    fflush(stdout);
    int status = fly(episodes, seed, (double)seconds);
    close(udp);
    return status;
}
