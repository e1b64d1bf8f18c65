/* Whether the vehicle rests, by the spread of the samples and by the fixes, as robins.ins.rest has it. */
#ifndef NAVIGATION_REST_H
#define NAVIGATION_REST_H

#include "navigation_blocks.h"

static double calmest = INFINITY; /* least unrest in motion, of fixes that are forgotten */

/* Mean and spread of rates and forces over so many increments up to one. */
static inline void statistics(int at, int width, double *mean, double *spread) {
  int first = at + 1 > width ? at + 1 - width : 0, n = at + 1 - first;
  for (int j = 0; j < 6; j++) {
    mean[j] = spread[j] = 0.0;
    for (int pass = 0; pass < 2; pass++) {
      for (int k = first; k <= at; k++) {
        double x = (j < 3 ? steps[k].theta[j] : steps[k].dv[j - 3]) / steps[k].dt;
        if (pass) spread[j] += (x - mean[j]) * (x - mean[j]) / n;
        else mean[j] += x / n;
      }
    }
    spread[j] = sqrt(spread[j]);
  }
}

/* Rates and forces of the window up to an increment: its unrest; returns whether it looks still. */
static inline int looks_still(int at, double *mean) {
  double spread[6];
  int still = at + 1 >= REST_WIDTH;
  statistics(at, REST_WIDTH, mean, spread);
  steps[at].unrest = 0.0;
  for (int j = 0; j < 6; j++) {
    double quiet = j < 3 ? QUIET_RATE : QUIET_ACCEL;
    steps[at].unrest = fmax(steps[at].unrest, spread[j] / quiet);
    still = still && spread[j] < quiet && (j > 2 || fabs(mean[j]) < 4.0 * quiet);
  }
  return still;
}

/* Of a fix the least unrest since the one before. */
static inline void note_calm(int at) {
  row *now = &fixes[at];
  int before = at - 1;
  now->calm = INFINITY;
  while (before >= 0 && fixes[before].moves < 0) before--;
  if (before < 0 || now->moves <= 0 || fixes[before].moves <= 0) return;
  if (now->time_s - fixes[before].time_s > WAIT_S) return;
  for (int k = 0; k < count && steps[k].end_s < now->time_s; k++) {
    if (steps[k].end_s >= fixes[before].time_s) now->calm = fmin(now->calm, steps[k].unrest);
  }
}

/* Whether the vehicle rests at an increment, and the mean rates and forces up to it. While fixes come
 * the last one decides; without them, whether it is plainly calmer than it was between two fixes that
 * said, as did the next, that it moves. */
static inline int rests(int at, double *mean) {
  double least = calmest, end_s = steps[at].end_s;
  int still = looks_still(at, mean);
  const row *last = NULL;
  for (int k = 0; k < heard && fixes[k].time_s <= end_s + TIME_TOLERANCE_S; k++) {
    if (fixes[k].moves < 0) continue;
    if (last && fixes[k].moves) least = fmin(least, last->calm);
    last = &fixes[k];
  }
  if (last && end_s - last->time_s <= WAIT_S) return still && !last->moves;
  return still && isfinite(least) && steps[at].unrest < 0.5 * least;
}

/* Forgets fixes that nothing asks for any more, of those up to a time. */
static inline void forget_fixes(double until_s) {
  int over = 0, next_one;
  for (; over < heard && fixes[over].time_s <= until_s; over++) {
    const row *old = &fixes[over];
    if (old->moves < 0) continue;
    for (next_one = over + 1; next_one < heard && fixes[next_one].moves < 0;) next_one++;
    if (next_one == heard || fixes[next_one].time_s > until_s) break;
    if (fixes[next_one].moves) calmest = fmin(calmest, old->calm);
  }
  memmove(fixes, fixes + over, sizeof *fixes * (size_t)(heard -= over));
}

#endif
