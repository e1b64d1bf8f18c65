/* A gyro as a part of the test bench: the whole of a board. See docs/board.md. */
#define PART ROBINS_PART_GYRO
#include "part_loop.h"

static robins_gyro sample;

static void begin_anew(void) { begin_gyro(); }

static void hear(robins_header head, const uint8_t *payload) {
  if (head.type == ROBINS_MOUNTED) turn_table(head.time_ns, (const robins_mounted *)payload);
}

static void compute(uint64_t time_ns) { read_gyro(time_ns, &sample); }

static void answer(uint64_t time_ns) { send(ROBINS_GYRO, time_ns, &sample, sizeof sample); }
