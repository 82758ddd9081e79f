/* The exchange of one control cycle in C, for comparison with its cost in Python.
 *
 *     cc -O2 -o master master.c && ./master vcan0 1000 20000
 *
 * Arguments: interface, period in us, number of cycles. Each cycle is SYNC, two TPDOs and RPDO, and every 25 ms the
 * master's heartbeat, with SCHED_FIFO 50 and locked memory. Prints the lateness and the busy time of each cycle in ns, one
 * line per cycle.
 */
#define _GNU_SOURCE
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { NODE = 1, HEARTBEAT_US = 25000 };

static int64_t now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static void fail(const char *what)
{
    perror(what);
    exit(1);
}

static void send_frame(int bus, canid_t id, const void *data, unsigned char length)
{
    struct can_frame frame = {.can_id = id, .len = length};
    memcpy(frame.data, data, length);
    if (write(bus, &frame, sizeof frame) != sizeof frame)
        fail("write");
}

int main(int argc, char **argv)
{
    if (argc != 4) {
        fprintf(stderr, "usage: master CHANNEL PERIOD_US CYCLES\n");
        return 2;
    }
    const int64_t period_ns = atoll(argv[2]) * 1000;
    const long cycles = atol(argv[3]);
    int64_t *late_ns = calloc(cycles, sizeof *late_ns), *busy_ns = calloc(cycles, sizeof *busy_ns);

    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct ifreq interface = {0};
    strncpy(interface.ifr_name, argv[1], IFNAMSIZ - 1);
    if (bus < 0 || ioctl(bus, SIOCGIFINDEX, &interface) < 0)
        fail(argv[1]);
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = interface.ifr_ifindex};
    if (bind(bus, (struct sockaddr *)&address, sizeof address) < 0)
        fail("bind");
    struct sched_param priority = {50};
    if (sched_setscheduler(0, SCHED_FIFO, &priority) < 0 || mlockall(MCL_CURRENT | MCL_FUTURE) < 0)
        perror("not in real time");

    struct { uint16_t statusword; int32_t motor; int16_t torque; } __attribute__((packed)) drive = {0};
    struct { int32_t load, demand; } __attribute__((packed)) encoders = {0};
    struct { uint16_t controlword; int32_t target; } __attribute__((packed)) command = {0x0f, 0};

    int64_t deadline_ns = now_ns() + period_ns, heartbeat_ns = 0;
    for (long cycle = 0; cycle < cycles; cycle++, deadline_ns += period_ns) {
        struct timespec deadline = {deadline_ns / 1000000000, deadline_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL))
            ;
        int64_t woke_ns = now_ns();
        late_ns[cycle] = woke_ns - deadline_ns;
        send_frame(bus, 0x80, "", 0);
        for (int seen = 0; seen < 2;) {
            struct can_frame frame;
            if (read(bus, &frame, sizeof frame) != sizeof frame)
                fail("read");
            if (frame.can_id == 0x180 + NODE) {
                memcpy(&drive, frame.data, sizeof drive);
                seen++;
            } else if (frame.can_id == 0x280 + NODE) {
                memcpy(&encoders, frame.data, sizeof encoders);
                seen++;
            }
        }
        command.target = drive.motor;
        send_frame(bus, 0x200 + NODE, &command, sizeof command);
        if (woke_ns >= heartbeat_ns) {
            heartbeat_ns = woke_ns + HEARTBEAT_US * 1000LL;
            send_frame(bus, 0x77f, "\x05", 1);
        }
        busy_ns[cycle] = now_ns() - woke_ns;
    }
    for (long cycle = 0; cycle < cycles; cycle++)
        printf("%lld %lld\n", (long long)late_ns[cycle], (long long)busy_ns[cycle]);
    return 0;
}
