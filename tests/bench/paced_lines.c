/* Lines of LDCN or NMC drives, each behind a pseudo-terminal, paced to the byte: the far end of the bench.
 *
 * One thread that sleeps until shortly before each byte and then spins: to spin all the time would keep the kernel's own
 * work on the terminals waiting, so among several lines it yields while it spins. Every instant follows from when the
 * request was read, so being late once does not add up. It answers what a host needs to bring a line up and to poll it;
 * nothing moves.
 *
 * usage: paced_lines LINES MODULES SEED READY_BAUD BURST DEVICE VERSION
 *   LINES, MODULES  how many lines, and how many drives on each
 *   READY_BAUD  0: just powered up, without addresses, at 19200; else addressed 1..MODULES at this rate
 *   BURST       1: a reply arrives in one piece at its end; 0: byte by byte
 *   DEVICE, VERSION  what the drives say they are: 90 20 for LS-182AP, 0 4 for PIC-SERVO
 * Prints a list of the terminals' paths and, for every SIGUSR1, one of figures since the one before, each in one line.
 * Source of the protocol: LS-182AP manual, "Serial command interface", "Command description"; PIC-SERVO manual, 5.2.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define CYCLE_NS 512000.0
#define CLOCK_HZ 1250000.0
#define SPIN_NS 40000.0
#define PATIENCE_NS 100000000.0
#define LONGEST_GAP_NS 50000000LL
#define RECORDS 200000
#define MOST_LINES 8

struct module { int address; int group; int items; };

struct line {
    int master;
    struct module module_at[32];
    int addressed, divisor;
    unsigned char packet[32], reply[32];
    int have, reply_bytes, sent;
    double heard_until, reply_starts, node_byte, request_over;
    int64_t reply_over, exchange_count, late_count, gap_count, began;
    double ideal_sum;
    float gap_us[RECORDS], late_us[RECORDS];
};

static struct line line_at[MOST_LINES];
static int lines, modules, burst, device, version;
static uint64_t dice;
static volatile sig_atomic_t report_wanted;

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static double lot(void) /* uniform in 0..1 (splitmix64) */
{
    uint64_t z = (dice += 0x9E3779B97F4A7C15ULL);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ULL;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBULL;
    return ((z ^ (z >> 31)) >> 11) * (1.0 / 9007199254740992.0);
}

static double host_baud(int master)
{
    struct termios t;
    tcgetattr(master, &t);
    switch (cfgetospeed(&t)) {
    case B9600: return 9600;
    case B19200: return 19200;
    case B57600: return 57600;
    case B115200: return 115200;
    case B230400: return 230400;
    default: return 38400;
    }
}

static void power_up(struct line *l)
{
    for (int i = 0; i < modules; i++)
        l->module_at[i] = (struct module){.address = 0, .group = 0xFF, .items = 0};
    l->addressed = 0;
    l->divisor = 0x3F;
}

static void put(struct line *l, int value, int width)
{
    for (int i = 0; i < width; i++)
        l->reply[l->reply_bytes++] = (value >> (8 * i)) & 0xFF;
}

static void status(struct line *l, int items)
{
    l->reply_bytes = 0;
    put(l, 0x69, 1); /* move done, power on, no diagnostic */
    /* a shaft that stands and is not quite still: what a daemon would not believe it would ask again */
    if (items & 0x01) put(l, (int)(l->exchange_count / 8 & 0x3), 4);
    if (items & 0x02) put(l, (int)(l->exchange_count & 0xFF), device == 90 ? 2 : 1);
    if (items & 0x04) put(l, 0, 2);
    if (items & 0x08) put(l, 0, 1);
    if (items & 0x10) put(l, 0, 4);
    if (items & 0x20) { put(l, device, 1); put(l, version, 1); }
    if (items & 0x40 && device == 90) put(l, 0, 2);
    int sum = 0;
    for (int i = 0; i < l->reply_bytes; i++)
        sum += l->reply[i];
    put(l, sum & 0xFF, 1);
}

/* Obey a whole packet whose last bit came at `over`. */
static void obey(struct line *l, double over)
{
    const unsigned char *packet = l->packet;
    int address = packet[1], command = packet[2] & 0x0F, first = packet[2] >> 4 ? packet[3] : 0;
    struct module *m = NULL;
    double answers_at = CLOCK_HZ / (l->divisor + 1);
    if (command == 0xF) { power_up(l); return; }
    if (address >= 0x80) {
        if (command == 0xA) l->divisor = first;
        return;
    }
    if (address == 0) {
        if (l->addressed == modules || command != 0x1) return;
        m = &l->module_at[l->addressed++];
        m->address = first;
        m->group = packet[4] | 0x80;
    } else {
        for (int i = 0; i < l->addressed; i++)
            if (l->module_at[i].address == address) m = &l->module_at[i];
        if (!m) return;
        if (command == 0x2) m->items = first;
    }
    status(l, command == 0x3 ? first : m->items);
    l->sent = 0;
    l->node_byte = 1e10 / answers_at;
    l->reply_starts = over + lot() * CYCLE_NS;
    l->request_over = over;
}

/* Read what the host has written until `at`. */
static void take(struct line *l, int64_t at)
{
    unsigned char data[256];
    ssize_t count = read(l->master, data, sizeof data);
    if (count <= 0) return;
    double byte = 1e10 / host_baud(l->master), module_baud = CLOCK_HZ / (l->divisor + 1);
    double ratio = 1e10 / byte / module_baud;
    if (l->reply_over && at - l->reply_over < LONGEST_GAP_NS && l->gap_count < RECORDS)
        l->gap_us[l->gap_count++] = (at - l->reply_over) * 1e-3;
    l->reply_over = 0; /* what comes next may be the rest of this request */
    if (ratio < 0.955 || ratio > 1.045) { l->have = 0; return; }
    for (ssize_t i = 0; i < count; i++) {
        l->heard_until = (l->heard_until > at ? l->heard_until : at) + byte;
        if (l->have == 0 && data[i] != 0xAA) continue;
        l->packet[l->have++] = data[i];
        if (l->have < 4 || l->have < 4 + (l->packet[2] >> 4)) continue;
        int sum = 0, bytes = l->have;
        for (int k = 1; k < bytes - 1; k++)
            sum += l->packet[k];
        l->have = 0;
        if ((sum & 0xFF) != l->packet[bytes - 1]) continue;
        l->reply_bytes = 0;
        obey(l, l->heard_until);
        if (l->reply_bytes) {
            l->ideal_sum += bytes * byte + (l->reply_starts - l->request_over) + l->reply_bytes * l->node_byte;
            l->exchange_count++;
        }
    }
}

static int is_answering(const struct line *l) { return l->sent < l->reply_bytes; }

/* Write what is due by `now`; return when the next piece is. */
static double answer(struct line *l, int64_t now)
{
    while (is_answering(l)) {
        int next = burst ? l->reply_bytes : l->sent + 1;
        double due = l->reply_starts + next * l->node_byte;
        if (now < due) return due;
        if (write(l->master, l->reply + l->sent, next - l->sent) < 0 && errno != EAGAIN && errno != EINTR) {
            perror("write");
            exit(1);
        }
        if (l->late_count < RECORDS) l->late_us[l->late_count++] = (now - due) * 1e-3;
        l->sent = next;
        if (!is_answering(l)) l->reply_over = now; /* how late we were is not the turn-around of the host */
        now = now_ns();
    }
    return now + PATIENCE_NS;
}

static int by_size(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

static double quantile(float *values, int64_t count, double share)
{
    if (count > RECORDS) count = RECORDS;
    if (count == 0) return 0;
    qsort(values, count, sizeof *values, by_size);
    return values[(int64_t)((count - 1) * share)];
}

static void report(struct line *l)
{
    int64_t now = now_ns();
    printf("{\"exchanges\": %lld, \"elapsed_s\": %.6f, \"ideal_s\": %.6f, \"turnaround_p50_us\": %.2f, "
           "\"turnaround_p99_us\": %.2f, \"late_p99_us\": %.2f}",
           (long long)l->gap_count, (now - l->began) * 1e-9, l->ideal_sum * 1e-9, quantile(l->gap_us, l->gap_count, 0.5),
           quantile(l->gap_us, l->gap_count, 0.99), quantile(l->late_us, l->late_count, 0.99));
    l->gap_count = l->late_count = 0;
    l->ideal_sum = 0;
    l->began = now;
}

static void report_all(void)
{
    for (int i = 0; i < lines; i++) {
        printf(i ? ", " : "[");
        report(&line_at[i]);
    }
    printf("]\n");
    fflush(stdout);
}

static void want_report(int number) { (void)number; report_wanted = 1; }

static void open_line(struct line *l, int ready_baud)
{
    int slave;
    struct termios raw;
    power_up(l);
    if (ready_baud) {
        l->divisor = ready_baud == 19200 ? 0x3F : (int)(CLOCK_HZ / ready_baud + 0.5) - 1;
        for (; l->addressed < modules; l->addressed++)
            l->module_at[l->addressed].address = l->addressed + 1;
    }
    if (openpty(&l->master, &slave, NULL, NULL, NULL)) { perror("openpty"); exit(1); }
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    cfsetspeed(&raw, B19200);
    tcsetattr(slave, TCSANOW, &raw);
    fcntl(l->master, F_SETFL, O_NONBLOCK);
    printf("%s\"%s\"", l == line_at ? "[" : ", ", ttyname(slave));
    l->began = now_ns();
}

/* Wait until the host says something on a line that is not answering, but not past `due`; spin when that is near. */
static void listen_until(double due)
{
    struct pollfd in[MOST_LINES];
    struct line *asked[MOST_LINES];
    int idle = 0;
    for (int i = 0; i < lines; i++)
        if (!is_answering(&line_at[i])) {
            in[idle] = (struct pollfd){.fd = line_at[i].master, .events = POLLIN};
            asked[idle++] = &line_at[i];
        }
    double nap_ns = due - now_ns() - SPIN_NS;
    if (nap_ns < 0 && idle == 0 && lines == 1) return;
    if (nap_ns < 0) {
        nap_ns = 0;
        sched_yield();
    }
    struct timespec nap = {.tv_nsec = (long)nap_ns};
    if (ppoll(in, idle, &nap, NULL) <= 0) return;
    int64_t now = now_ns();
    for (int i = 0; i < idle; i++)
        if (in[i].revents & POLLIN) take(asked[i], now);
}

int main(int count, char **argument)
{
    if (count != 8) return 2;
    lines = atoi(argument[1]);
    modules = atoi(argument[2]);
    dice = strtoull(argument[3], NULL, 10);
    burst = atoi(argument[5]);
    device = atoi(argument[6]);
    version = atoi(argument[7]);
    if (lines < 1 || lines > MOST_LINES) return 2;
    struct sigaction action = {.sa_handler = want_report};
    sigaction(SIGUSR1, &action, NULL);
    prctl(PR_SET_TIMERSLACK, 1UL);
    for (int i = 0; i < lines; i++)
        open_line(&line_at[i], atoi(argument[4]));
    printf("]\n");
    fflush(stdout);
    for (;;) {
        if (report_wanted) { report_wanted = 0; report_all(); }
        double due = now_ns() + PATIENCE_NS;
        for (int i = 0; i < lines; i++) {
            double next = answer(&line_at[i], now_ns());
            if (next < due) due = next;
        }
        listen_until(due);
    }
}
