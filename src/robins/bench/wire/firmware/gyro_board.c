/* A gyro as a part of the test bench: the whole loop of a board. See docs/board.md.
 *
 * It says hello until the bench answers with begin. A tick asks for the sample of one step, done
 * tells that it has been sent; a tick that comes again, since an answer was lost, has the same
 * answer again. After stop, or a begin of another run, all begins anew. */
#include "platform.h"

static uint32_t run, sequence, next; /* run 0: none; next: the step that has not been done yet */
static robins_gyro sample;
static robins_done done;

static void send(uint8_t type, uint64_t time_ns, const void *payload, size_t size) {
  static uint8_t out[ROBINS_MOST_FRAME];
  write_bytes(out, robins_encode(type, run, sequence++, time_ns, payload, size, out));
}

static void take(robins_header head, const uint8_t *payload) {
  if (head.type == ROBINS_BEGIN && head.run != run) {
    run = head.run, sequence = next = 0;
    begin_gyro();
  }
  if (!run || head.run != run) return; /* an earlier run left it in a buffer */
  if (head.type == ROBINS_STOP) run = sequence = 0;
  if (head.type == ROBINS_MOUNTED) turn_table(head.time_ns, (const robins_mounted *)payload);
  if (head.type != ROBINS_TICK) return;
  uint32_t step = ((const robins_tick *)payload)->step;
  if (step >= next) {
    uint64_t began_ns = now_ns();
    read_gyro(head.time_ns, &sample);
    done.step = step, done.compute = (uint32_t)(now_ns() - began_ns);
    next = step + 1;
  }
  if (step + 1 != next) return; /* its sample is forgotten */
  send(ROBINS_GYRO, head.time_ns, &sample, sizeof sample);
  send(ROBINS_DONE, head.time_ns, &done, sizeof done);
}

int main(int argc, char **argv) {
  static const robins_hello hello = {ROBINS_PART_GYRO, ROBINS_SCHEMA};
  static robins_receiver in;
  uint8_t byte;
  open_line(argc > 1 ? argv[1] : "");
  for (uint64_t hello_ns = 0;;) {
    if (read_bytes(&byte, 1) && robins_message(&in, byte)) take(robins_head(&in), robins_payload(&in));
    if (run || now_ns() < hello_ns) continue;
    send(ROBINS_HELLO, 0, &hello, sizeof hello);
    hello_ns = now_ns() + 500000000u;
  }
}
