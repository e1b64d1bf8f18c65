/* Where the filter begins: level on rest or on the quietest second, heading by the course of the first
 * fix that is fast enough. The rules are those of robins.systems.ins_gnss.start. */
#ifndef NAVIGATION_START_H
#define NAVIGATION_START_H

#include "navigation_rest.h"

/* The increment up to which the vehicle rested for long enough, of those up to one, and the mean rate
 * at rest; -1: it did not rest. */
static inline int rested(int last, double *bias) {
  int found = -1, still = 0;
  double mean[6];
  bias[0] = bias[1] = bias[2] = 0.0;
  for (int i = 0; i <= last; i++) {
    if (!rests(i, mean)) continue;
    if (still++ <= LEVEL_WIDTH) found = i;
    for (int j = 0; j < 3; j++) bias[j] += mean[j];
  }
  for (int j = 0; j < 3 && still; j++) bias[j] /= still;
  return found;
}

/* The product of two quaternions, into the first. */
static inline void turn(double *p, const double *q) {
  double w = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
  double x = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2];
  double y = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1];
  double z = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0];
  double length = sqrt(w * w + x * x + y * y + z * z);
  p[0] = w / length, p[1] = x / length, p[2] = y / length, p[3] = z / length;
}

static inline void by_vector(const double *phi, double *q) {
  double half = 0.5 * sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]);
  double factor = half > 0.0 ? 0.5 * sin(half) / half : 0.5;
  q[0] = cos(half);
  for (int i = 0; i < 3; i++) q[i + 1] = factor * phi[i];
}

/* The attitude: level where it rested or was the quietest, and carried by the gyros to `last`. */
static inline int levelled(int last, double course_rad, double *q, double *bias, double *tilt) {
  double mean[6], spread[6], *f = mean + 3, calmest = INFINITY, by[4];
  int at = rested(last, bias), moving = at < 0;
  int first = LEVEL_WIDTH - 1 < last ? LEVEL_WIDTH - 1 : last;
  *tilt = moving ? 3.0 * TILT : TILT;
  for (int k = first; moving && k <= last; k++) {
    double sum = 0.0;
    statistics(k, LEVEL_WIDTH, mean, spread);
    for (int j = 3; j < 6; j++) sum += spread[j] * spread[j];
    if (sum < calmest) calmest = sum, at = k;
  }
  statistics(at, LEVEL_WIDTH, mean, spread);
  double size = sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
  if (size < 4.9 || size > 14.7 || hypot(f[1], f[2]) < 1e-3 * size) return 0; /* it is no gravity */
  double roll = 0.5 * atan2(-f[1], -f[2]), pitch = 0.5 * atan2(f[0], hypot(f[1], f[2]));
  q[0] = cos(roll) * cos(pitch), q[1] = sin(roll) * cos(pitch);
  q[2] = cos(roll) * sin(pitch), q[3] = -sin(roll) * sin(pitch);
  for (int k = at + 1; k <= last; k++) {
    double phi[3];
    for (int i = 0; i < 3; i++) phi[i] = steps[k].theta[i] - bias[i] * steps[k].dt;
    by_vector(phi, by);
    turn(q, by);
  }
  double heading = atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]));
  double down[3] = {0.0, 0.0, course_rad - heading};
  by_vector(down, by);
  turn(by, q);
  memcpy(q, by, sizeof by);
  return 1;
}

/* Begins a filter at the first whole fix from where the course is known; returns that fix, or NULL. */
static inline const row *find_start(filter_state *x) {
  static filter_reset_belief belief;
  filter_reset_result told;
  double until_s = steps[count - 1].end_s - REACH_S, bias[3], q[4], tilt, arm[3] = {LEVER_ARM};
  int fast = -1, begins = -1, last = 0;
  for (int k = 0; k < heard && fixes[k].time_s <= until_s && begins < 0; k++) {
    const double *v = fixes[k].v_n, *p = fixes[k].place;
    if (fast < 0 && fixes[k].time_s > steps[0].end_s && hypot(v[0], v[1]) >= COURSE_SPEED) fast = k;
    if (fast >= 0 && isfinite(p[0]) && isfinite(p[1]) && isfinite(p[2])) begins = k;
  }
  if (begins < 0) return NULL;
  while (steps[last].end_s < fixes[fast].time_s) last++;
  for (int k = 0; k < heard; k++) note_calm(k);
  double course = atan2(fixes[fast].v_n[1], fixes[fast].v_n[0]);
  if (!levelled(last, course, q, bias, &tilt)) return NULL;
  filter_init(x);
  memcpy(&belief, x, sizeof belief); /* the same fields in the same order, at the head of the state */
  memcpy(belief.MEAN(q_nb_wxyz), q, sizeof q);
  memcpy(belief.MEAN(gyro_bias), bias, sizeof bias);
  belief.factor[0][0] = belief.factor[1][1] = tilt;
  double vector = sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), angle = 2.0 * atan2(vector, q[0]);
  if (vector > 0.0) rotate(angle / vector, q + 1, arm);
  for (int i = 0; i < 3; i++) {
    double v = VELOCITIES && isfinite(fixes[begins].v_n[i]) ? fixes[begins].v_n[i] : 0.0;
    belief.MEAN(v_n)[i] = v;
    belief.factor[6 + i][6 + i] = hypot(START_POSITION, fixes[begins].sigma_m[i]);
    arm[i] = v * LATENCY_S - arm[i];
  }
  const double *p = fixes[begins].place, E2 = 0.0066943799901413165, A = 6378137.0;
  double w = 1.0 - E2 * sin(p[0]) * sin(p[0]), across = A / sqrt(w);
  double lon = p[1] + arm[1] / ((across + p[2]) * cos(p[0])), whole = 2.0 * acos(-1.0);
  belief.MEAN(position_lat) = p[0] + arm[0] / (across * (1.0 - E2) / w + p[2]);
  belief.MEAN(position_lon) = lon - whole * floor(lon / whole + 0.5);
  belief.MEAN(position_alt) = p[2] - arm[2];
  filter_reset(x, &belief, &told);
  return &fixes[begins];
}

#endif
