/* What a board has to give the loop in gyro_board.c: its serial line, its clock, its gyros. Loops of
 * other parts need the line and the clock. */
#ifndef ROBINS_PLATFORM_H
#define ROBINS_PLATFORM_H

#include "robins_wire.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Opens the line: raw, 8 data bits, no parity, one stop bit, no flow control. `path` is for
 * platforms that have several lines. */
void open_line(const char *path);

/* Waits for some milliseconds at most. Returns the bytes read into `data`; 0: none came. */
size_t read_bytes(uint8_t *data, size_t most);

/* Writes all of it, waiting where the line is full. */
void write_bytes(const uint8_t *data, size_t size);

/* A clock that never goes back. */
uint64_t now_ns(void);

#ifdef ROBINS_MOUNTED /* the wire has a rate table */
/* A run begins: whatever the gyros have gathered is thrown away. */
void begin_gyro(void);

/* The attitude that a rate table has at `time_ns`. A board on a real table, or on the craft, turns
 * with it and has no use for this. */
void turn_table(uint64_t time_ns, const robins_mounted *mounted);

/* The turn over the step that has ended at `time_ns` [rad], body axes; NaN: no sample of an axis. */
void read_gyro(uint64_t time_ns, robins_gyro *sample);
#endif

#ifdef __cplusplus
}
#endif

#endif
