/* A stage `c-gauge` in plain C that makes two channels of its own and declares their noise, and an effect
 * `c-gauge-gain` that acts on both.
 *
 *   gauge.x (m s-2, measured as it is)   w_k + h_k + GAIN s_k,   h_k = (a_{k-1} + a_k)/2
 *   gauge.y (m s-2, from displacements)  (d_{k+1} - 2 d_k + d_{k-1})/dt^2 + 0.8 h_k + GAIN (u_{k-1} + u_k)/2
 *
 * w, a and d are white Gaussian noise, s and u known random series; each value is a hash of its time, so that batches
 * do not matter. */
#include <dragfree/rows.h>
#include <math.h>
#include <stdio.h>

static const double PI = 3.14159265358979323846;
static const double DT_S = 0.1, GAIN = 2.0;
/* One-sided amplitude spectral densities: own noise of x, common acceleration, readout of y; and of the known
 * series. */
static const double OWN = 3e-10, COMMON = 4e-10, READOUT = 1e-12, SERIES = 1e-9;

typedef struct {
  double level; /* declared over true amplitude of x's own noise */
  char fault[16]; /* what is wrong with the declaration */
  dragfree_slot_v1 any;
} gauge;

static uint64_t hash(uint64_t x) {
  x += 0x9e3779b97f4a7c15u;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
  return x ^ (x >> 31);
}

/* A sample of white noise: of one-sided ASD a its variance is a^2 / (2 dt). */
static double white(double asd, uint64_t stream, int64_t epoch) {
  uint64_t a = hash(hash(stream) ^ (uint64_t)epoch), b = hash(a);
  double u = ((double)(a >> 11) + 0.5) / 9007199254740992.0, v = (double)(b >> 11) / 9007199254740992.0;
  return asd / sqrt(2.0 * DT_S) * sqrt(-2.0 * log(u)) * cos(2.0 * PI * v);
}

static int64_t epoch_of(int64_t time_ns) { return (time_ns + 50000000) / 100000000; }
static double series(uint64_t channel, int64_t k) { return white(SERIES, 4 + channel, k); }

static const char *gauge_manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"c-gauge\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"Channels of its own\",\"parameters\":["
         "{\"name\":\"level\",\"type\":\"f64\",\"default\":1.0,\"minimum\":0.1,\"maximum\":10.0},"
         "{\"name\":\"fault\",\"type\":\"text\",\"default\":\"\"}]}";
}

static dragfree_status gauge_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  gauge *g = self;
  char noise[2048];
  const char *own = strcmp(g->fault, "channel") ? "gauge.x" : "gauge.w";
  const char *power = strcmp(g->fault, "number") ? "1.0" : "1e999";
  const char *row = strcmp(g->fault, "size") ? "[0.8]" : "[0.8,0.1]";
  dragfree_column_v1 want = {"grid", "is.tm1.r_orf_m.y", NULL, NULL, 0.0, NULL};
  if (link->read(link->context, &want, &g->any)) return say(error, DRAGFREE_ERROR, "no grid");
  snprintf(noise, sizeof noise,
           "{\"kind\":\"channel\",\"channel\":\"gauge.x\",\"average\":\"1\",\"noise_processes\":["
           "{\"name\":\"gauge:own\",\"unit\":\"m s-2\",\"spectrum\":[{\"asd\":%.17g,\"corner_hz\":1.0,\"exponent\":0}],"
           "\"response\":\"direct\",\"enters\":{\"%s\":[%s]}},"
           "{\"name\":\"gauge:common\",\"unit\":\"m s-2\",\"spectrum\":[{\"asd\":%.17g,\"corner_hz\":1.0,\"exponent\":0}],"
           "\"response\":\"held\",\"enters\":{\"gauge.x\":[1.0],\"gauge.y\":%s}},"
           "{\"name\":\"gauge:readout\",\"unit\":\"m\",\"spectrum\":[{\"asd\":%.17g,\"corner_hz\":1.0,\"exponent\":0}],"
           "\"response\":\"differenced\",\"enters\":{\"gauge.y\":[1.0]}}]}",
           g->level * OWN, own, power, COMMON, row, READOUT);
  dragfree_column_v1 x = {"c-gauge", "gauge.x", "m s-2", "", 1.0 / DT_S, noise};
  dragfree_column_v1 y = {"c-gauge", "gauge.y", "m s-2", "", 1.0 / DT_S,
                          "{\"kind\":\"channel\",\"channel\":\"gauge.y\",\"average\":\"2\"}"};
  if (link->write(link->context, &x) || link->write(link->context, &y))
    return say(error, DRAGFREE_ERROR, "a channel was refused");
  return DRAGFREE_OK;
}

static dragfree_status gauge_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                     dragfree_error_v1 *error) {
  gauge *g = self;
  const struct ArrowArray *table = &inputs->tables[g->any.table];
  const int64_t *time_ns = input(table, -1);
  if (!make_table(&outputs[0], time_ns, table->length, 2)) return say(error, DRAGFREE_FATAL, "no memory");
  double *x = column(&outputs[0], 0), *y = column(&outputs[0], 1);
  for (int64_t i = 0; i < table->length; i++) {
    int64_t k = epoch_of(time_ns[i]);
    double held = 0.5 * (white(COMMON, 2, k - 1) + white(COMMON, 2, k));
    double d[3] = {white(READOUT, 3, k - 1), white(READOUT, 3, k), white(READOUT, 3, k + 1)};
    x[i] = white(OWN, 1, k) + held + GAIN * series(0, k);
    y[i] = (d[2] - 2.0 * d[1] + d[0]) / (DT_S * DT_S) + 0.8 * held + 0.5 * GAIN * (series(1, k - 1) + series(1, k));
  }
  return DRAGFREE_OK;
}

static dragfree_status gauge_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                    dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  gauge *g = calloc(1, sizeof *g);
  const char *fault = NULL;
  if (!g) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_f64(config->context, "parameters.level", &g->level) ||
      config->get_text(config->context, "parameters.fault", &fault)) {
    free(g);
    return say(error, DRAGFREE_ERROR, "no parameters");
  }
  strncpy(g->fault, fault, sizeof g->fault - 1);
  dragfree_node_v1 made = {0};
  made.self = g;
  made.link = gauge_link;
  made.process = gauge_process;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

/* --- effect `c-gauge-gain`: the gain of each channel for its known series --- */

static const char *gain_manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"c-gauge-gain\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"Gains\"}";
}

static dragfree_status gain_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  gauge *g = self;
  dragfree_column_v1 want = {"c-gauge", "gauge.x", NULL, NULL, 0.0, NULL};
  if (link->read(link->context, &want, &g->any)) return say(error, DRAGFREE_ERROR, "no gauge");
  for (const char *axis = "xy"; *axis; axis++) {
    char coefficient[128], name[64], attributes[128];
    snprintf(coefficient, sizeof coefficient, "{\"name\":\"c-gauge-gain.%c\",\"unit\":\"1\",\"lower\":-9.0,\"upper\":9.0}", *axis);
    snprintf(name, sizeof name, "c-gauge-gain.%c@gauge.%c", *axis, *axis);
    snprintf(attributes, sizeof attributes,
             "{\"kind\":\"regressor\",\"coefficient\":\"c-gauge-gain.%c\",\"channel\":\"gauge.%c\"}", *axis, *axis);
    dragfree_column_v1 regressor = {"effect/c-gauge-gain:", name, "m s-2", "", 1.0 / DT_S, attributes};
    if (link->coefficient(link->context, coefficient) || link->write(link->context, &regressor))
      return say(error, DRAGFREE_ERROR, "a coefficient was refused");
  }
  return DRAGFREE_OK;
}

static dragfree_status gain_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                    dragfree_error_v1 *error) {
  gauge *g = self;
  const struct ArrowArray *table = &inputs->tables[g->any.table];
  const int64_t *time_ns = input(table, -1);
  if (!make_table(&outputs[0], time_ns, table->length, 2)) return say(error, DRAGFREE_FATAL, "no memory");
  for (int64_t channel = 0; channel < 2; channel++)
    for (int64_t i = 0; i < table->length; i++)
      column(&outputs[0], channel)[i] = series((uint64_t)channel, epoch_of(time_ns[i]));
  return DRAGFREE_OK;
}

static dragfree_status gain_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                   dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  (void)config;
  gauge *g = calloc(1, sizeof *g);
  if (!g) return say(error, DRAGFREE_ERROR, "no memory");
  dragfree_node_v1 made = {0};
  made.self = g;
  made.link = gain_link;
  made.process = gain_process;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 stages = {1, gauge_manifest, gauge_create};
static const dragfree_factory_v1 effects = {1, gain_manifest, gain_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  if (!strcmp(id, DRAGFREE_STAGE_V1)) return &stages;
  if (!strcmp(id, DRAGFREE_EFFECT_V1)) return &effects;
  return NULL;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
