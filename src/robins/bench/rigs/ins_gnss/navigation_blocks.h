/* Increments of the samples of a vehicle, and what the filter takes of them: blocks, rates.
 *
 * The formulas are those of robins.ins.increments and robins.ins.blocks, in the order of the samples
 * that come. */
#ifndef NAVIGATION_BLOCKS_H
#define NAVIGATION_BLOCKS_H

#include <math.h>
#include <string.h>

#include "filter.h"
#include "navigation_given.h"

#define TIME_TOLERANCE_S 1e-9 /* times that are nearer are one */
#define USUAL (PIECES - 8) /* pieces that a block has room for in a replay */

typedef struct {
  double end_s, dt, theta[3], dv[3]; /* s since the first sample, s, rad, m/s */
  double unrest; /* spread over the window up to here, in thresholds of rest */
} increment;

typedef struct { /* of a fix, as the filter believes it; NaN is missing */
  double time_s, place[3], sigma_m[3], v_n[3], sigma_v[3];
  int moves; /* whether it tells that the vehicle moves; -1: neither */
  double calm; /* least unrest since the fix before, where both tell that it moves */
} row;

static int64_t origin_ns, raw_ns[4]; /* of the first sample; of the last four */
static double raw[4][6]; /* rates and forces */
static int samples, count; /* in raw; increments that are known for good */
static row fixes[FIXES];
static int heard; /* in fixes, in the order of time */
static increment steps[STEPS + 2]; /* of two samples or more the one at `count` is known nearly */

static const double points[2] = {0.21132486540518713, 0.7886751345948129}; /* of Gauss */

static inline double seconds(int64_t time_ns) { return (double)(time_ns - origin_ns) * 1e-9; }

static inline void cross(const double *a, const double *b, double *to) {
  for (int i = 0; i < 3; i++) to[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

/* Turns v by the rotation vector factor * phi (Rodrigues). */
static inline void rotate(double factor, const double *phi, double *v) {
  double by[3] = {factor * phi[0], factor * phi[1], factor * phi[2]}, once[3], twice[3];
  double angle = sqrt(by[0] * by[0] + by[1] * by[1] + by[2] * by[2]);
  double sine = angle > 0.0 ? sin(angle) / angle : 1.0;
  double half = angle > 0.0 ? sin(0.5 * angle) / (0.5 * angle) : 1.0;
  cross(by, v, once);
  cross(by, once, twice);
  for (int i = 0; i < 3; i++) v[i] += sine * once[i] + 0.5 * half * half * twice[i];
}

/* The increment between two of the last samples, by the rule for rates of robins.ins.increments. */
static inline void integrate(int at, increment *to) {
  double knots[4] = {0.0}, x[2][6], most = 0.0, least = INFINITY, *w1 = x[0], *w2 = x[1];
  for (int k = 0; k + 1 < samples; k++) {
    double dt = (double)(raw_ns[k + 1] - raw_ns[k]) * 1e-9;
    knots[k + 1] = knots[k] + dt, most = fmax(most, dt), least = fmin(least, dt);
  }
  double h = (double)(raw_ns[at + 1] - raw_ns[at]) * 1e-9, coning[3], a[3], b[3];
  int cubic = samples == 4 && most <= 2.0 * least;
  for (int g = 0; g < 2; g++) {
    for (int j = 0; j < 6; j++) x[g][j] = 0.0;
    for (int i = 0; i < samples; i++) {
      double weight = i == at ? 1.0 - points[g] : i == at + 1 ? points[g] : 0.0;
      if (cubic) weight = 1.0;
      for (int j = 0; cubic && j < 4; j++) {
        if (i != j) weight *= (knots[at] + points[g] * h - knots[j]) / (knots[i] - knots[j]);
      }
      for (int j = 0; j < 6; j++) x[g][j] += weight * raw[i][j];
    }
  }
  cross(w1, w2, coning);
  for (int i = 0; i < 3; i++) {
    to->theta[i] = 0.5 * h * (w1[i] + w2[i]) + sqrt(3.0) / 12.0 * h * h * coning[i];
    a[i] = 0.25 * w1[i] + (0.25 - sqrt(3.0) / 6.0) * w2[i];
    b[i] = (0.25 + sqrt(3.0) / 6.0) * w1[i] + 0.25 * w2[i];
  }
  rotate(h, a, w1 + 3);
  rotate(h, b, w2 + 3);
  for (int i = 3; i < 6; i++) to->dv[i - 3] = 0.5 * h * (w1[i] + w2[i]);
  to->end_s = seconds(raw_ns[at + 1]), to->dt = h;
}

/* The transition of a block is that of four parts of its room, whose noise is looked at by the numbers
 * of pieces (robins.ins.transition). Here each part has two more; they are left empty where the pieces
 * that are looked at stay the same. */
static inline void spread_out(filter_predict_input *block, int n) {
  int each = USUAL / 4, wide = each + 2, early = (int)(points[0] * wide), late = (int)(points[1] * wide);
  int a = early > (int)(points[0] * each) ? 0 : early;
  int b = late > (int)(points[1] * each) + 1 ? wide / 2 : wide - 1;
  for (int k = n - 1; k >= 0; k--) {
    int i = k % each, to = i + (i >= a);
    to = k / each * wide + to + (to >= b);
    double dt = block->increments_dt[k];
    block->increments_dt[k] = 0.0, block->increments_dt[to] = dt;
    for (int j = 0; j < 3; j++) {
      double theta = block->increments_theta[k][j], dv = block->increments_dv[k][j];
      block->increments_theta[k][j] = block->increments_dv[k][j] = 0.0;
      block->increments_theta[to][j] = theta, block->increments_dv[to][j] = dv;
    }
  }
}

/* Predicts over the pieces of increments from one time to another; of so many increments. */
static inline void predict(filter_state *x, double from_s, double to_s, int known, int is_epoch) {
  static filter_predict_input block;
  filter_predict_result moved;
  int n = 0;
  memset(&block, 0, sizeof block);
  block.noise_scale = 1.0;
  for (int k = 0; k < known && from_s < to_s; k++) {
    const increment *s = &steps[k];
    if (s->end_s <= from_s) continue;
    double begin_s = from_s, end_s = fmin(s->end_s, to_s);
    double share = fmin((end_s - begin_s) / s->dt, 1.0);
    double before = fmin(fmax((begin_s - (s->end_s - s->dt)) / s->dt, 0.0), 1.0);
    from_s = end_s;
    if (end_s - begin_s <= TIME_TOLERANCE_S) continue;
    if (share > 1.0 - 1e-6) share = 1.0, before = 0.0;
    if (n == PIECES) { /* stamps in bursts: the block is taken in two */
      filter_predict(x, &block, &moved);
      memset(&block, 0, sizeof block);
      block.noise_scale = 1.0, n = 0;
    }
    int late = k + 1 < known && steps[k + 1].dt < 0.5 * SAMPLE_S; /* its stamp: nothing is missing */
    if (s->dt > 1.5 * SAMPLE_S && !late) block.noise_scale = GAP_NOISE;
    for (int i = 0; i < 3; i++) {
      block.increments_theta[n][i] = share * s->theta[i];
      block.increments_dv[n][i] = share * s->dv[i];
    }
    if (before > 0.0) rotate(-before, s->theta, block.increments_dv[n]);
    block.increments_dt[n++] = share * s->dt;
  }
  if (is_epoch && n <= USUAL) spread_out(&block, n);
  filter_predict(x, &block, &moved);
}

/* Mean rate over the increments that end about a time. */
static inline void rate_about(double at_s, double *rate) {
  int a = 0, b;
  double length = 0.0;
  while (a < count && steps[a].end_s < at_s - REACH_S) a++;
  for (b = a; b < count && steps[b].end_s < at_s + REACH_S;) b++;
  b = b > a ? b : a + 1 < count ? a + 1 : count;
  a = a < b ? a : b - 1;
  rate[0] = rate[1] = rate[2] = 0.0;
  for (; a < b; length += steps[a++].dt) {
    for (int i = 0; i < 3; i++) rate[i] += steps[a].theta[i];
  }
  for (int i = 0; i < 3; i++) rate[i] /= length;
}

/* What a velocity that is a mean over a window is older by, as robins.ins.blocks has it. */
static inline void gained_before(double at_s, double window_s, double *gained_b, double *age_s) {
  int last = 0, k;
  while (last + 1 < count && steps[last].end_s < at_s - TIME_TOLERANCE_S) last++;
  for (k = last; k > 0 && steps[k - 1].end_s > at_s - window_s;) k--;
  gained_b[0] = gained_b[1] = gained_b[2] = *age_s = 0.0;
  for (; window_s > 0.0 && k <= last; k++) { /* each turns what was gained before it */
    double end_s = fmin(steps[k].end_s, at_s);
    double begin_s = fmax(steps[k].end_s - steps[k].dt, at_s - window_s);
    double length = fmax(end_s - begin_s, 0.0), share = length / steps[k].dt;
    double weight = 1.0 - (at_s - 0.5 * (begin_s + end_s)) / window_s;
    for (int i = 0; i < 3; i++) gained_b[i] += weight * share * steps[k].dv[i];
    rotate(-share, steps[k].theta, gained_b);
    *age_s += weight * length;
  }
}

#endif
