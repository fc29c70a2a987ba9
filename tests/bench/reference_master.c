/* The floor of the bench: what a blocking program with nothing else to do gets out of the same line.
 *
 * Sends one packet after another to the modules in turn and waits for each reply whole.
 *
 * usage: reference_master TERMINAL BAUD MODULES STATUS_ITEMS REPLY_BYTES
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/time.h>
#include <termios.h>
#include <unistd.h>

#define PATIENCE_US 100000
#define SILENCE_US 20000

static void ring(int number) { (void)number; }

int main(int count, char **argument)
{
    if (count != 6) return 2;
    int baud = atoi(argument[2]), modules = atoi(argument[3]), items = atoi(argument[4]), bytes = atoi(argument[5]);
    int line = open(argument[1], O_RDWR | O_NOCTTY);
    if (line < 0) { perror(argument[1]); return 1; }
    struct termios settings;
    tcgetattr(line, &settings);
    cfmakeraw(&settings);
    cfsetspeed(&settings, baud == 115200 ? B115200 : baud == 57600 ? B57600 : B19200);
    settings.c_cc[VMIN] = bytes;
    settings.c_cc[VTIME] = 0;
    tcsetattr(line, TCSANOW, &settings);
    /* an exchange that two alarms have interrupted is lost, as it may be when this program is stopped in the middle */
    struct sigaction action = {.sa_handler = ring};
    sigaction(SIGALRM, &action, NULL);
    struct itimerval alarm = {{0, PATIENCE_US}, {0, PATIENCE_US}};
    setitimer(ITIMER_REAL, &alarm, NULL);
    for (int address = 1;; address = address % modules + 1) {
        unsigned char request[5] = {0xAA, address, 0x13, items, (address + 0x13 + items) & 0xFF}, reply[32];
        ssize_t put;
        do put = write(line, request, sizeof request);
        while (put < 0 && errno == EINTR); /* an alarm came first, nothing was written */
        if (put != sizeof request) return 1;
        int have = 0;
        for (int alarms = 0; have < bytes && alarms < 2;) {
            ssize_t got = read(line, reply + have, bytes - have);
            if (got > 0) have += got;
            else if (got < 0 && errno == EINTR) alarms++;
            else return 1;
        }
        unsigned sum = 0;
        for (int i = 0; i < bytes - 1; i++)
            sum += reply[i];
        if (have < bytes || (sum & 0xFF) != reply[bytes - 1]) { /* out of step: wait for the line to fall silent */
            usleep(SILENCE_US);
            tcflush(line, TCIFLUSH);
        }
    }
}
