/* A PC in the place of a board, for trying the loop without hardware:
 *
 *     cc -std=c99 -I. gyro_board.c platform_posix.c -lm -o gyro_board
 *     ./gyro_board /dev/pts/5
 *
 * A PC does not turn, so its gyro is a perfect one on a simulated rate table: the sample is the turn
 * between the attitudes of the table at both ends of the step. In the first step of a run, and where
 * no attitude came, it is NaN; the next sample then has the turn of all that was left out, as that of
 * a gyro that adds up. For a board, write these functions again: its UART, timer and sensor. */
#define _XOPEN_SOURCE 600
#define _DEFAULT_SOURCE /* speeds above 38400 baud */
#define _DARWIN_C_SOURCE

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "platform.h"

static int line = -1;

static void end(const char *what) {
  perror(what);
  exit(1);
}

void open_line(const char *path) {
  struct termios mode;
  line = open(path, O_RDWR | O_NOCTTY);
  if (line < 0 || tcgetattr(line, &mode)) end(path);
  mode.c_iflag = mode.c_oflag = mode.c_lflag = 0;
  mode.c_cflag = CS8 | CREAD | CLOCAL;
  mode.c_cc[VMIN] = mode.c_cc[VTIME] = 0;
  /* The speed must be that of `--node`, here 460800. */
  cfsetispeed(&mode, B115200);
  cfsetospeed(&mode, B115200);
#ifdef B460800
  cfsetispeed(&mode, B460800);
  cfsetospeed(&mode, B460800);
#endif
  if (tcsetattr(line, TCSANOW, &mode)) end(path);
}

size_t read_bytes(uint8_t *data, size_t most) {
  static uint8_t held[512];
  static size_t first, count;
  if (!count) {
    struct pollfd wait = {line, POLLIN, 0};
    if (poll(&wait, 1, 20) <= 0) return 0;
    ssize_t got = read(line, held, sizeof held);
    if (got < 0 && errno == EINTR) return 0;
    if (got <= 0) end("the line is gone");
    first = 0;
    count = (size_t)got;
  }
  size_t size = most < count ? most : count;
  memcpy(data, held + first, size);
  first += size;
  count -= size;
  return size;
}

void write_bytes(const uint8_t *data, size_t size) {
  while (size) {
    ssize_t put = write(line, data, size);
    if (put < 0 && errno != EINTR) end("the line is gone");
    if (put < 0) continue;
    data += put;
    size -= (size_t)put;
  }
}

uint64_t now_ns(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

#ifdef ROBINS_MOUNTED
/* Attitudes of the table, body to inertial: of the last sample, and the last that came. */
static double before[4], after[4];
static uint64_t after_ns; /* 0: none came */
static int before_known;

void begin_gyro(void) {
  before_known = 0;
  after_ns = 0;
}

void turn_table(uint64_t time_ns, const robins_mounted *mounted) {
  memcpy(after, mounted->q_ib, sizeof after);
  after_ns = time_ns;
}

/* The rotation vector of conj(p) q. */
static void turn_between(const double *p, const double *q, double *theta_b) {
  double w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
  double v[3] = {p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2],
                 p[0] * q[2] + p[1] * q[3] - p[2] * q[0] - p[3] * q[1],
                 p[0] * q[3] - p[1] * q[2] + p[2] * q[1] - p[3] * q[0]};
  double length = sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]);
  /* q and -q are one attitude, and the turn is the shorter one */
  double factor = length > 0 ? 2 * atan2(length, fabs(w)) / length : 2;
  for (int k = 0; k < 3; k++) theta_b[k] = (w < 0 ? -factor : factor) * v[k];
}

void read_gyro(uint64_t time_ns, robins_gyro *sample) {
  double theta_b[3] = {NAN, NAN, NAN};
  int came = after_ns == time_ns;
  if (came && before_known) turn_between(before, after, theta_b);
  if (came) memcpy(before, after, sizeof before);
  before_known |= came;
  memcpy(sample->theta_b, theta_b, sizeof theta_b);
}
#endif
