/* A line of LDCN or NMC drives behind a pseudo-terminal, paced to the byte: the far end of the bench.
 *
 * One thread that sleeps until shortly before each byte and then spins: to spin all the time would keep the kernel's own
 * work on the terminal waiting. Every instant follows from when the request was read, so being late once does not add
 * up. It answers what a host needs to bring a line up and to poll it; nothing moves.
 *
 * usage: paced_line MODULES SEED READY_BAUD BURST DEVICE VERSION
 *   READY_BAUD  0: just powered up, without addresses, at 19200; else addressed 1..MODULES at this rate
 *   BURST       1: a reply arrives in one piece at its end; 0: byte by byte
 *   DEVICE, VERSION  what the drives say they are: 90 20 for LS-182AP, 0 4 for PIC-SERVO
 * Prints {"terminal": PATH} and, for every SIGUSR1, one line of figures since the one before.
 * Source of the protocol: LS-182AP manual, "Serial command interface", "Command description"; PIC-SERVO manual, 5.2.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
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
#define LONGEST_GAP_NS 50000000LL
#define RECORDS 200000

struct module { int address; int group; int items; };
static struct module module_at[32];
static int modules, addressed, divisor = 0x3F, device, version;
static uint64_t dice;

static unsigned char packet[32];
static int have;
static unsigned char reply[32];
static int reply_bytes, sent;
static double reply_starts, node_byte, request_over;

static int64_t exchange_count, late_count, gap_count, began;
static double ideal_sum;
static float gap_us[RECORDS], late_us[RECORDS];
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

static void power_up(void)
{
    for (int i = 0; i < modules; i++)
        module_at[i] = (struct module){.address = 0, .group = 0xFF, .items = 0};
    addressed = 0;
    divisor = 0x3F;
}

static void put(int value, int width)
{
    for (int i = 0; i < width; i++)
        reply[reply_bytes++] = (value >> (8 * i)) & 0xFF;
}

static void status(int items)
{
    reply_bytes = 0;
    put(0x69, 1); /* move done, power on, no diagnostic */
    if (items & 0x01) put((int)exchange_count, 4);
    if (items & 0x02) put((int)(exchange_count & 0xFF), device == 90 ? 2 : 1);
    if (items & 0x04) put((int)(exchange_count & 0x7), 2);
    if (items & 0x08) put(0, 1);
    if (items & 0x10) put(0, 4);
    if (items & 0x20) { put(device, 1); put(version, 1); }
    if (items & 0x40 && device == 90) put(0, 2);
    int sum = 0;
    for (int i = 0; i < reply_bytes; i++)
        sum += reply[i];
    put(sum & 0xFF, 1);
}

/* Obey a whole packet whose last bit came at `over`. */
static void obey(double over)
{
    int address = packet[1], command = packet[2] & 0x0F, first = packet[2] >> 4 ? packet[3] : 0;
    struct module *m = NULL;
    double answers_at = CLOCK_HZ / (divisor + 1);
    if (command == 0xF) { power_up(); return; }
    if (address >= 0x80) {
        if (command == 0xA) divisor = first;
        return;
    }
    if (address == 0) {
        if (addressed == modules || command != 0x1) return;
        m = &module_at[addressed++];
        m->address = first;
        m->group = packet[4] | 0x80;
    } else {
        for (int i = 0; i < addressed; i++)
            if (module_at[i].address == address) m = &module_at[i];
        if (!m) return;
        if (command == 0x2) m->items = first;
    }
    status(command == 0x3 ? first : m->items);
    sent = 0;
    node_byte = 1e10 / answers_at;
    reply_starts = over + lot() * CYCLE_NS;
    request_over = over;
}

static void take(int master, int64_t at)
{
    unsigned char data[256];
    ssize_t count = read(master, data, sizeof data);
    if (count <= 0) return;
    double byte = 1e10 / host_baud(master), module_baud = CLOCK_HZ / (divisor + 1), ratio = 1e10 / byte / module_baud;
    if (ratio < 0.955 || ratio > 1.045) { have = 0; return; }
    for (ssize_t i = 0; i < count; i++) {
        if (have == 0 && data[i] != 0xAA) continue;
        packet[have++] = data[i];
        if (have < 4 || have < 4 + (packet[2] >> 4)) continue;
        int sum = 0, bytes = have;
        for (int k = 1; k < have - 1; k++)
            sum += packet[k];
        have = 0;
        if ((sum & 0xFF) != packet[bytes - 1]) continue;
        reply_bytes = 0;
        obey(at + (i + 1) * byte);
        if (reply_bytes) {
            ideal_sum += (i + 1) * byte + (reply_starts - request_over) + reply_bytes * node_byte;
            exchange_count++;
        }
    }
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

static void report(void)
{
    int64_t now = now_ns();
    printf("{\"exchanges\": %lld, \"elapsed_s\": %.6f, \"ideal_s\": %.6f, \"turnaround_p50_us\": %.2f, "
           "\"turnaround_p99_us\": %.2f, \"late_p99_us\": %.2f}\n",
           (long long)gap_count, (now - began) * 1e-9, ideal_sum * 1e-9, quantile(gap_us, gap_count, 0.5),
           quantile(gap_us, gap_count, 0.99), quantile(late_us, late_count, 0.99));
    fflush(stdout);
    gap_count = late_count = 0;
    ideal_sum = 0;
    began = now_ns();
}

static void want_report(int number) { (void)number; report_wanted = 1; }

int main(int count, char **argument)
{
    if (count != 7) return 2;
    modules = atoi(argument[1]);
    dice = strtoull(argument[2], NULL, 10);
    int ready_baud = atoi(argument[3]), burst = atoi(argument[4]);
    device = atoi(argument[5]);
    version = atoi(argument[6]);
    power_up();
    if (ready_baud) {
        divisor = (int)(CLOCK_HZ / ready_baud + 0.5) - 1;
        if (ready_baud == 19200) divisor = 0x3F;
        for (addressed = 0; addressed < modules; addressed++)
            module_at[addressed].address = addressed + 1;
    }
    int master, slave;
    struct termios raw;
    if (openpty(&master, &slave, NULL, NULL, NULL)) { perror("openpty"); return 1; }
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    cfsetspeed(&raw, B19200);
    tcsetattr(slave, TCSANOW, &raw);
    fcntl(master, F_SETFL, O_NONBLOCK);
    struct sigaction action = {.sa_handler = want_report};
    sigaction(SIGUSR1, &action, NULL);
    printf("{\"terminal\": \"%s\"}\n", ttyname(slave));
    fflush(stdout);

    int64_t reply_over = 0;
    prctl(PR_SET_TIMERSLACK, 1UL);
    struct pollfd in = {.fd = master, .events = POLLIN};
    began = now_ns();
    for (;;) {
        if (report_wanted) { report_wanted = 0; report(); }
        int64_t now = now_ns();
        if (reply_bytes && sent < reply_bytes) {
            int next = burst ? reply_bytes : sent + 1;
            double due = reply_starts + next * node_byte;
            if (now >= due) {
                if (write(master, reply + sent, next - sent) < 0 && errno != EAGAIN && errno != EINTR) { perror("write"); return 1; }
                if (late_count < RECORDS) late_us[late_count++] = (now - due) * 1e-3;
                sent = next;
                if (sent == reply_bytes)
                    reply_over = (int64_t)due;
            } else if (due - now > SPIN_NS) {
                struct timespec nap = {.tv_nsec = (long)(due - now - SPIN_NS)};
                nanosleep(&nap, NULL);
            }
            continue;
        }
        int ready = poll(&in, 1, 100);
        if (ready <= 0 || !(in.revents & POLLIN)) continue;
        now = now_ns();
        if (reply_over && now - reply_over < LONGEST_GAP_NS && gap_count < RECORDS)
            gap_us[gap_count++] = (now - reply_over) * 1e-3;
        take(master, now);
    }
}
