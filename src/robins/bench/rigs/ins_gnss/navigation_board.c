/* The navigation computer of INS/GNSS as a part of the test bench: a filter that `robins export`
 * wrote, on the wire. See docs/from-design-to-board.md.
 *
 * It does what the part "navigation" does: samples are integrated, blocks of them end at fixes and
 * where they get too long, and a block is taken once its end lies a little behind the newest sample.
 * A late fix goes back to the epoch before it. What the part was told is in navigation_given.h. */
#define PART ROBINS_PART_NAVIGATION
#include "part_loop.h"
#include "navigation_start.h"

#define AHEAD_S 10.0 /* of the newest sample, by which a fix may be */
#define MOST_WAITING 256 /* epochs that wait to be told: one is told a step */

enum { STARTING = 1, REFUSED = 2 }; /* of the state */

typedef struct { double time_s, wanted_s; int number; filter_state state; double wrong[2]; } epoch; /* see the part */

static robins_sample sample; /* what came, and the ends of its steps */
static robins_fix fix;
static uint64_t sample_ns, fix_ns;

static int64_t last_ns, elsewhere_ns; /* stamps: of the last sample; of those that do not follow it */
static int opened, elsewhere;
static epoch past[PAST];
static robins_epoch told[MOST_WAITING];
static int kept, waiting; /* of past (0: not begun), told */

static robins_state state; /* what was answered */
static robins_epoch passed;
static int says_state, says_epoch;

static void forget_all(void) { samples = count = heard = kept = 0, calmest = INFINITY; }

static void tell(const filter_state *x, const double *wrong, int64_t time_ns, robins_epoch *to) {
  to->time = (uint64_t)time_ns;
  memcpy(to->q_nb, x->MEAN(q_nb_wxyz), sizeof to->q_nb);
  memcpy(to->v_n, x->MEAN(v_n), sizeof to->v_n);
  to->lat = x->MEAN(position_lat), to->lon = x->MEAN(position_lon), to->alt = x->MEAN(position_alt);
  for (int i = 0; i < 9; i++) {
    double sum = 0.0;
    for (int j = 0; j <= i; j++) sum += x->factor[i][j] * x->factor[i][j];
    to->sigma[i] = sqrt(sum);
  }
  memcpy(to->wrong, wrong, sizeof to->wrong);
}

static void drop(int old) {
  memmove(steps, steps + old, sizeof *steps * (size_t)(count + 1 - old));
  count -= old;
}

/* One step of the filter, to an epoch, with what was measured there. */
static void step(double to_s, double wanted_s, int number) {
  filter_update_gnss_position_reading place = {NAN, NAN, NAN};
  filter_update_gnss_position_about about = {{1.0, 1.0, 1.0}, {0.0, 0.0, 0.0}};
  filter_update_gnss_position_result seen;
  double v_n[3] = {NAN, NAN, NAN}, sigma_v[3] = {1.0, 1.0, 1.0};
  if (kept == PAST) memmove(past, past + 1, sizeof *past * (size_t)--kept);
  epoch *now = &past[kept];
  *now = past[kept - 1];
  predict(&now->state, now->time_s, to_s, count, 1);
  now->time_s = to_s, now->wanted_s = wanted_s, now->number = number, kept++;
  for (int k = 0; k < heard; k++) {
    if (fabs(fixes[k].time_s - to_s) >= TIME_TOLERANCE_S) continue;
    place.lat = fixes[k].place[0], place.lon = fixes[k].place[1], place.alt = fixes[k].place[2];
    memcpy(about.sigma, fixes[k].sigma_m, sizeof about.sigma);
    memcpy(v_n, fixes[k].v_n, sizeof v_n);
    memcpy(sigma_v, fixes[k].sigma_v, sizeof sigma_v);
    note_calm(k);
  }
  rate_about(to_s, about.omega_b);
  filter_update_gnss_position(&now->state, &place, &about, &seen);
  REPORT_WRONG(seen, now->wrong);
#if VELOCITIES
  filter_update_gnss_velocity_reading velocity;
  filter_update_gnss_velocity_about fresh;
  filter_update_gnss_velocity_result velocity_result;
  int some = isfinite(v_n[0]) || isfinite(v_n[1]) || isfinite(v_n[2]);
  memcpy(velocity.value, v_n, sizeof v_n);
  memcpy(fresh.sigma, sigma_v, sizeof sigma_v);
  memcpy(fresh.omega_b, about.omega_b, sizeof fresh.omega_b);
  gained_before(to_s, some ? WINDOW_S : 0.0, fresh.gained_b, &fresh.age_s);
  filter_update_gnss_velocity(&now->state, &velocity, &fresh, &velocity_result);
  REPORT_WRONG(velocity_result, now->wrong);
#endif
#if REST
  filter_update_zero_velocity_reading zero_velocity_reading;
  filter_update_zero_velocity_result zero_velocity_result;
  filter_update_zero_rate_reading turns;
  filter_update_zero_rate_result turned;
  double mean[6];
  int last = 0;
  while (last + 1 < count && steps[last].end_s < to_s - TIME_TOLERANCE_S) last++;
  int still = rests(last, mean);
  for (int i = 0; i < 3; i++) {
    zero_velocity_reading.value[i] = still ? 0.0 : NAN;
    turns.value[i] = still ? mean[i] : NAN;
  }
  filter_update_zero_velocity(&now->state, &zero_velocity_reading, &zero_velocity_result);
  filter_update_zero_rate(&now->state, &turns, &turned);
  REPORT_WRONG(turned, now->wrong);
#endif
  if (waiting < MOST_WAITING) tell(&now->state, now->wrong, llrint(to_s * 1e9) + origin_ns, &told[waiting++]);
  int old = 0, gone = 0; /* one epoch before the longest delay is where a fix is counted from */
  while (past[old].time_s < to_s - DELAY_S) old++;
  if (old > 1) memmove(past, past + old - 1, sizeof *past * (size_t)(kept -= old - 1));
  forget_fixes(past[0].time_s);
  while (steps[gone].end_s <= past[0].time_s - BACK_S) gone++;
  if (gone > count / 2) drop(gone);
}

/* Looks for the start, ten times a second. */
static void seek(void) {
  if (!count) return;
  double now_s = steps[count - 1].end_s, dt = steps[count - 1].dt;
  if (now_s - steps[0].end_s > MOST_START_S) drop(count / 2);
  if ((int64_t)(10.0 * now_s) == (int64_t)(10.0 * (now_s - dt))) return;
  const row *fix = find_start(&past[0].state);
  if (!fix) return;
  past[0].time_s = past[0].wanted_s = fix->time_s, past[0].number = 0, kept = 1;
  past[0].wrong[0] = past[0].wrong[1] = NAN;
}

/* Takes all steps that can be taken. */
static void advance(void) {
  if (!kept) seek();
  while (kept) {
    const epoch *at = &past[kept - 1];
    int number = at->number + 1, k = 0;
    double edge_s = at->wanted_s + LONGEST_S * number, wanted_s = at->wanted_s;
    while (k < heard && fixes[k].time_s <= at->time_s) k++;
    if (k < heard && (fixes[k].time_s - at->wanted_s) / LONGEST_S - 1e-6 <= number) {
      edge_s = wanted_s = fixes[k].time_s, number = 0;
    }
    if (!count || steps[count - 1].end_s < edge_s + REACH_S) return;
    step(edge_s, wanted_s, number);
  }
}

/* To the last epoch that does not know of a fix. */
static void go_back(double time_s) {
  if (!kept || time_s > past[kept - 1].time_s + REACH_S) return;
  int keep = 1;
  for (int k = 0; k < kept; k++) {
    double due = (time_s - past[k].wanted_s) / LONGEST_S - 1e-6;
    if (past[k].time_s < time_s && (past[k].number == 0 || past[k].number < due)) keep = k + 1;
  }
  kept = keep;
}

/* Whether a sample comes in; stamps that stay elsewhere are a clock that was set: all begins anew. */
static int comes_in(int64_t time_ns, const double *values) {
  for (int k = 0; k < 6; k++) {
    if (!isfinite(values[k])) return 0;
  }
  int64_t ahead = opened ? time_ns - last_ns : 1, since = time_ns - elsewhere_ns;
  if (ahead <= 0 || ahead > LONGEST_GAP_NS) {
    elsewhere = elsewhere > 0 && since > 0 && since <= LONGEST_GAP_NS ? elsewhere + 1 : 1;
    elsewhere_ns = time_ns;
    if (elsewhere < PATIENCE) return 0;
    forget_all();
  }
  last_ns = time_ns, opened = 1, elsewhere = 0;
  return 1;
}

static int take_sample(void) {
  double values[6], mean[6];
  int64_t time_ns = (int64_t)sample.time;
  memcpy(values, sample.omega_s, sizeof sample.omega_s);
  memcpy(values + 3, sample.f_s, sizeof sample.f_s);
  if (!comes_in(time_ns, values)) return REFUSED;
  if (!samples) origin_ns = time_ns;
  if (samples == 4) {
    memmove(raw, raw + 1, 3 * sizeof *raw);
    memmove(raw_ns, raw_ns + 1, 3 * sizeof *raw_ns);
    samples = 3;
  }
  raw_ns[samples] = time_ns;
  for (int k = 0; k < 6; k++) {
    const double *C = C_BS[k % 3], *v = values + (k < 3 ? 0 : 3);
    raw[samples][k] = C[0] * v[0] + C[1] * v[1] + C[2] * v[2];
  }
  if (++samples == 4) { /* the increment before the last is known now */
    if (count >= STEPS - 1) drop(STEPS / 2);
    if (!count) integrate(0, &steps[count++]), looks_still(0, mean);
    integrate(1, &steps[count++]);
    looks_still(count - 1, mean);
  }
  if (samples > 1) integrate(samples - 2, &steps[count]);
  advance();
  return 0;
}

static int take_fix(void) {
  double v_n[3], spread[3], stated[3], factor = factor_of(fix.quality);
  double newest_s = samples > 1 ? steps[count].end_s : 0.0;
  int any = 0, at = heard;
  double time_s = samples ? seconds((int64_t)fix.time) : NAN;
  row one = {time_s, {fix.lat, fix.lon, fix.alt}, {0}, {0}, {0}, -1, INFINITY};
  memcpy(v_n, fix.v_n, sizeof v_n);
  memcpy(spread, fix.sigma_v, sizeof spread);
  memcpy(stated, fix.sigma, sizeof stated);
  for (int i = 0; i < 3; i++) { /* a component whose sigma is none is missing */
    one.place[i] = stated[i] > 0.0 ? one.place[i] : NAN;
    one.v_n[i] = spread[i] > 0.0 ? v_n[i] : NAN;
    one.sigma_m[i] = fmax((stated[i] > 0.0 ? stated[i] : 1.0) * factor, LEAST_SIGMA);
    one.sigma_v[i] = fmax((spread[i] > 0.0 ? spread[i] : 1.0) * factor, LEAST_VELOCITY_SIGMA);
    any |= isfinite(one.place[i]) || isfinite(one.v_n[i]);
    spread[i] = spread[i] > 0.0 ? spread[i] : 1.0;
  }
  double speed = hypot(one.v_n[0], one.v_n[1]);
  if (isfinite(speed)) one.moves = speed > fmax(MOVING_SPEED, 4.0 * fmax(spread[0], spread[1]));
  if (!(time_s > 0.0) || time_s > newest_s + AHEAD_S) return REFUSED;
  if (kept && time_s <= past[0].time_s + TIME_TOLERANCE_S) return REFUSED; /* too old */
  for (int k = 0; k < heard; k++) {
    if (fabs(fixes[k].time_s - time_s) < TIME_TOLERANCE_S) return REFUSED;
  }
  if (!any && !kept) return REFUSED; /* later a fix without a number is an epoch */
  if (heard == FIXES) memmove(fixes, fixes + 1, sizeof *fixes * (size_t)(at = --heard));
  for (; at > 0 && fixes[at - 1].time_s > time_s; at--) fixes[at] = fixes[at - 1];
  fixes[at] = one, heard++;
  go_back(time_s);
  advance();
  return any ? 0 : REFUSED;
}

static int starting(void) { return kept ? 0 : STARTING; }

/* All of a step: what came, then the state at the newest sample, by what it predicts from the epoch. */
static void compute(uint64_t time_ns) {
  static filter_state ahead;
  int flags = 0;
  uint64_t stamp = 0;
  says_state = sample_ns == time_ns || fix_ns == time_ns;
  if (sample_ns == time_ns) flags |= take_sample() | starting(), stamp = sample.time;
  if (fix_ns == time_ns) {
    flags |= take_fix() | starting();
    stamp = samples ? (uint64_t)raw_ns[samples - 1] : fix.time;
  }
  if (says_state) {
    double nothing[sizeof(robins_epoch) / sizeof(double) - 1];
    robins_epoch now;
    for (size_t k = 0; k < sizeof nothing / sizeof *nothing; k++) nothing[k] = NAN;
    now.time = stamp;
    memcpy((uint8_t *)&now + sizeof now.time, nothing, sizeof nothing);
    if (kept) {
      ahead = past[kept - 1].state;
      predict(&ahead, past[kept - 1].time_s, steps[count].end_s, count + 1, 0);
      tell(&ahead, past[kept - 1].wrong, (int64_t)stamp, &now);
    }
    memcpy(&state, &now, sizeof now);
    state.flags = (uint8_t)flags;
  }
  says_epoch = waiting > 0;
  if (says_epoch) passed = told[0], memmove(told, told + 1, sizeof *told * (size_t)--waiting);
}

static void begin_anew(void) {
  sample_ns = fix_ns = 0;
  opened = elsewhere = waiting = 0;
  forget_all();
}

static void hear(robins_header head, const uint8_t *payload) {
  if (head.type == ROBINS_SAMPLE) memcpy(&sample, payload, sizeof sample), sample_ns = head.time_ns;
  if (head.type == ROBINS_FIX) memcpy(&fix, payload, sizeof fix), fix_ns = head.time_ns;
}

static void answer(uint64_t time_ns) {
  if (says_state) send(ROBINS_STATE, time_ns, &state, sizeof state);
  if (says_epoch) send(ROBINS_EPOCH, time_ns, &passed, sizeof passed);
}
