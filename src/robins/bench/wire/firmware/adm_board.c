/* Attitude determination as a part of the test bench: a filter of the satellite that
 * `robins export` wrote, on the wire. See docs/board.md.
 *
 *     robins export satellite/s1 --filter mekf --to adm-c
 *     cc -std=c99 -O2 -ffp-contract=off adm_board.c robins.c platform_posix.c -lm -o adm_board
 *
 * the second in that folder, with this file and its neighbours in it. It does what the part "adm"
 * does: predicts with the gyro, updates with the star sensor, reports. A sample of the gyro stands
 * for one step more; then the rate is not known, and the filter starts again with the next
 * star frame after the gyro is back. */
#include <math.h>

#define PART ROBINS_PART_ADM
#include "part_loop.h"
#include "robins.h"

#ifndef STAR_STEPS
#define STAR_STEPS 5u /* between two frames of the star sensor */
#endif
#define SILENT_STEPS (4u * STAR_STEPS) /* after which it counts as silent */
#define UNIT 1e-3 /* that the length of a quaternion may be off by */
#define LIMIT 27.906455492522596 /* of the squared innovation: chi-square of 3 at 0.9999962 */

enum { USED = 1, REFUSED = 2, HELD = 4, SAFE = 8, SILENT = 16, SHORT = 32 }; /* of the estimate */

static robins_state filter;
static robins_predict_input turn; /* of the last step with a sample of the gyro */
static uint32_t gyro_age, since_star;
static int lost; /* waits for a star frame to start again */

static robins_gyro gyro; /* what came, and the ends of its steps */
static robins_star star;
static uint64_t gyro_ns, star_ns, reset_ns, step_ns;

static robins_innovation innovation; /* what was answered */
static robins_estimate estimate;
static int heard;

static int finite(const double *x, int count) {
  for (int k = 0; k < count; k++) {
    if (!isfinite(x[k])) return 0;
  }
  return 1;
}

static void begin_anew(void) {
  gyro_ns = star_ns = 0, reset_ns = UINT64_MAX;
  gyro_age = since_star = 0;
  lost = 0;
  memset(&turn, 0, sizeof turn); /* before the first sample: at rest */
  robins_init(&filter);
}

static int predicts(uint64_t time_ns) {
  robins_predict_result moved;
  double theta_b[3];
  memcpy(theta_b, gyro.theta_b, sizeof theta_b);
  int came = gyro_ns == time_ns && finite(theta_b, 3);
  if (came) memcpy(turn.value, theta_b, sizeof theta_b);
  gyro_age = came ? 0 : gyro_age + 1;
  lost |= gyro_age > 1;
  lost |= !next && time_ns > step_ns; /* it was without power until now */
  if (reset_ns == time_ns - step_ns) robins_init(&filter), lost = 1; /* sent after the step before */
  if (!lost) robins_predict(&filter, &turn, &moved);
  return came ? 0 : HELD;
}

/* The attitude of a frame, with the bias that was known and all else as at the start. */
static void restart(const double *q_ib, double squared) {
  static robins_reset_belief belief;
  robins_reset_result told;
  memcpy(belief.mean_gyro_bias, filter.mean_gyro_bias, sizeof belief.mean_gyro_bias);
  for (int k = 0; k < 4; k++) belief.mean_attitude_wxyz[k] = q_ib[k] / sqrt(squared);
  robins_init(&filter);
  memcpy(belief.factor, filter.factor, sizeof belief.factor);
  robins_reset(&filter, &belief, &told); /* all modes of a bank */
  lost = 0;
}

static int updates(void) {
  robins_update_star_reading reading;
  robins_update_star_result seen;
  double q_ib[4], squared = 0.0;
  memcpy(q_ib, star.q_ib, sizeof q_ib);
  for (int k = 0; k < 4; k++) squared += q_ib[k] * q_ib[k];
  int whole = finite(q_ib, 4);
  heard = whole && fabs(squared - 1.0) <= 2.0 * UNIT;
  int flags = whole && !heard ? SHORT : 0;
  if (lost) {
    if (!heard || gyro_age > 1) return flags;
    restart(q_ib, squared);
    heard = 2; /* nothing was expected */
    return flags | USED;
  }
  for (int k = 0; k < 4; k++) reading.wxyz[k] = heard ? q_ib[k] : NAN;
  int code = robins_update_star(&filter, &reading, &seen);
  memcpy(innovation.innovation, seen.innovation, sizeof innovation.innovation);
  memcpy(innovation.sigma, seen.sigma, sizeof innovation.sigma);
  innovation.ratio = seen.dof ? seen.nis / LIMIT : NAN;
  return flags | (code == 0 ? USED : 0) | (code == 3 ? REFUSED : 0);
}

static void compute(uint64_t time_ns) {
  heard = 0;
  int flags = predicts(time_ns);
  if (star_ns == time_ns) flags |= updates();
  since_star = heard ? 0 : since_star + 1;
  if (since_star > SILENT_STEPS) flags |= SILENT;
  if (lost) flags |= SAFE;
  memcpy(estimate.q_ib, filter.mean_attitude_wxyz, sizeof estimate.q_ib);
  memcpy(estimate.gyro_bias, filter.mean_gyro_bias, sizeof estimate.gyro_bias);
  for (int i = 0; i < 6; i++) {
    double sum = 0.0;
    for (int j = 0; j <= i; j++) sum += filter.factor[i][j] * filter.factor[i][j];
    estimate.sigma[i] = lost ? NAN : sqrt(sum);
  }
  estimate.flags = (uint8_t)flags;
}

static void hear(robins_header head, const uint8_t *payload) {
  if (head.type == ROBINS_BEGIN) step_ns = ((const robins_begin *)payload)->step;
  if (head.type == ROBINS_GYRO) memcpy(&gyro, payload, sizeof gyro), gyro_ns = head.time_ns;
  if (head.type == ROBINS_STAR) memcpy(&star, payload, sizeof star), star_ns = head.time_ns;
  if (head.type == ROBINS_MODE && ((const robins_mode *)payload)->reset) reset_ns = head.time_ns;
}

static void answer(uint64_t time_ns) {
  if (heard == 1) send(ROBINS_INNOVATION, time_ns, &innovation, sizeof innovation);
  send(ROBINS_ESTIMATE, time_ns, &estimate, sizeof estimate);
}
