/* The loop of a part of the test bench, see docs/wire.md. A part defines PART, its number, then
 * includes this file, and has the four functions below.
 *
 * It sends hello until the bench answers with begin. A tick requests a step, done tells that all of its
 * answer has been sent; a tick that comes again, since an answer was lost, has the same answer again.
 * After stop, or a begin of another run, all starts again. */
#include "platform.h"

static void begin_anew(void); /* a run begins */
static void hear(robins_header head, const uint8_t *payload); /* messages with data, as they come */
static void compute(uint64_t time_ns); /* the step that ends then, once */
static void answer(uint64_t time_ns); /* by `send`; again where a tick comes again */

static uint32_t run, sequence, next; /* run 0: none; next: the step that has not been done yet */

static void send(uint8_t type, uint64_t time_ns, const void *payload, size_t size) {
  static uint8_t out[ROBINS_MOST_FRAME];
  write_bytes(out, robins_encode(type, run, sequence++, time_ns, payload, size, out));
}

static void take(robins_header head, const uint8_t *payload) {
  static robins_done done;
  if (head.type == ROBINS_BEGIN && head.run != run) run = head.run, sequence = next = 0, begin_anew();
  if (!run || head.run != run) return; /* an earlier run left it in a buffer */
  if (head.type == ROBINS_STOP) run = sequence = 0;
  if (head.type != ROBINS_TICK) hear(head, payload);
  if (head.type != ROBINS_TICK) return;
  uint32_t step = ((const robins_tick *)payload)->step;
  if (step >= next) {
    uint64_t began_ns = now_ns();
    compute(head.time_ns);
    done.step = step, done.compute = (uint32_t)(now_ns() - began_ns);
    next = step + 1;
  }
  if (step + 1 != next) return; /* its answer is forgotten */
  answer(head.time_ns);
  send(ROBINS_DONE, head.time_ns, &done, sizeof done);
}

int main(int argc, char **argv) {
  static const robins_hello hello = {PART, ROBINS_SCHEMA};
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
