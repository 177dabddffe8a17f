/* Source of libv1_c.so: a stage and an effect in plain C. See README.md. */
#include <dragfree/rows.h>
#include <math.h>
#include <stdio.h>

/* --- stage `v1-c-scale`: a column of the grid times a parameter, and the number of rows that it saw as its state --- */

typedef struct {
  double factor;
  double rate_hz;
  dragfree_slot_v1 x;
  uint64_t rows;
} scale;

static const char *scale_manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"v1-c-scale\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"A stage in C\",\"parameters\":["
         "{\"name\":\"factor\",\"type\":\"f64\",\"unit\":\"1\",\"default\":2.0,\"minimum\":0.0,\"maximum\":10.0,"
         "\"help\":\"what to multiply by\"}]}";
}

static dragfree_status scale_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  scale *s = self;
  dragfree_column_v1 want = {"grid", "is.tm1.r_orf_m.y", "m", "ORF_1", 0.0, NULL};
  for (uint32_t i = 0; i < link->available_count; i++)
    if (!strcmp(link->available[i].table, "grid")) s->rate_hz = link->available[i].rate_hz;
  if (link->read(link->context, &want, &s->x)) return say(error, DRAGFREE_ERROR, "no displacement");
  dragfree_column_v1 scaled = {"v1-c-scale", "tm1.scaled_orf_m.y", "m", "ORF_1", s->rate_hz, "{\"archive\":\"true\"}"};
  return link->write(link->context, &scaled);
}

static dragfree_status scale_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                     dragfree_error_v1 *error) {
  scale *s = self;
  const struct ArrowArray *table = &inputs->tables[s->x.table];
  const double *x = input(table, s->x.column);
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *scaled = column(&outputs[0], 0);
  for (int64_t i = 0; i < table->length; i++) scaled[i] = s->factor * x[i];
  s->rows += (uint64_t)table->length;
  return DRAGFREE_OK;
}

static dragfree_status scale_report(void *self, const char *earlier, const dragfree_writer_v1 *writer,
                                    dragfree_error_v1 *error) {
  (void)earlier;
  (void)error;
  char text[128];
  int n = snprintf(text, sizeof text, "{\"counts\":{\"rows\":%llu}}", (unsigned long long)((scale *)self)->rows);
  return writer->write(writer->context, (const uint8_t *)text, (size_t)n);
}

static dragfree_status scale_save(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error) {
  (void)error;
  scale *s = self;
  return writer->write(writer->context, (const uint8_t *)&s->rows, sizeof s->rows);
}

static dragfree_status scale_load(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error) {
  scale *s = self;
  if (length != sizeof s->rows) return say(error, DRAGFREE_ERROR, "no state of v1-c-scale");
  memcpy(&s->rows, bytes, length);
  return DRAGFREE_OK;
}

static dragfree_status scale_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                    dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  scale *s = calloc(1, sizeof *s);
  if (!s) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_f64(config->context, "parameters.factor", &s->factor)) {
    free(s);
    return say(error, DRAGFREE_ERROR, "no factor");
  }
  host->log(host->context, DRAGFREE_LOG_INFO, "v1-c-scale is alive");
  dragfree_node_v1 made = {0};
  made.self = s;
  made.link = scale_link;
  made.process = scale_process;
  made.report = scale_report;
  made.save = scale_save;
  made.load = scale_load;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

/* --- effect `v1-c-es-gain`: a gain error of the electrostatic force along y, F_E / m_m per unit --- */

typedef struct {
  double mass_kg;
  char instance[8];
  dragfree_slot_v1 force;
} gain;

static const char *gain_manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"v1-c-es-gain\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"An effect in C\","
         "\"instances\":[\"tm1\",\"tm2\"]}";
}

static dragfree_status gain_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  gain *g = self;
  char name[64], text[256], attributes[256], table[64];
  double rate_hz = 0.0;
  for (uint32_t i = 0; i < link->available_count; i++) rate_hz = fmax(rate_hz, link->available[i].rate_hz);
  snprintf(name, sizeof name, "command.%s.force_orf_n.y", g->instance);
  dragfree_column_v1 want = {"grid", name, "N", NULL, 0.0, NULL};
  if (link->read(link->context, &want, &g->force)) return say(error, DRAGFREE_ERROR, "no commanded force");
  snprintf(text, sizeof text,
           "{\"name\":\"v1-c-es-gain.%s.y\",\"unit\":\"1\",\"frame\":\"\",\"lower\":-0.5,\"upper\":0.5,\"initial\":0.0,"
           "\"prior_sigma\":0.3}",
           g->instance);
  if (link->coefficient(link->context, text)) return say(error, DRAGFREE_ERROR, "coefficient refused");
  snprintf(name, sizeof name, "v1-c-es-gain.%s.y@%s.accel.y", g->instance, g->instance);
  snprintf(table, sizeof table, "effect/v1-c-es-gain:%s", g->instance);
  snprintf(attributes, sizeof attributes,
           "{\"kind\":\"regressor\",\"coefficient\":\"v1-c-es-gain.%s.y\",\"channel\":\"%s.accel.y\"}", g->instance,
           g->instance);
  dragfree_column_v1 regressor = {table, name, "m s-2", "", rate_hz, attributes};
  return link->write(link->context, &regressor);
}

static dragfree_status gain_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                    dragfree_error_v1 *error) {
  gain *g = self;
  const struct ArrowArray *table = &inputs->tables[g->force.table];
  const double *force = input(table, g->force.column);
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *regressor = column(&outputs[0], 0);
  for (int64_t i = 0; i < table->length; i++) regressor[i] = force[i] / g->mass_kg;
  return DRAGFREE_OK;
}

static dragfree_status gain_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                   dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  gain *g = calloc(1, sizeof *g);
  const char *instance = NULL;
  char path[64];
  if (!g) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_text(config->context, "instance", &instance) || strlen(instance) >= sizeof g->instance) {
    free(g);
    return say(error, DRAGFREE_ERROR, "no instance");
  }
  strcpy(g->instance, instance);
  snprintf(path, sizeof path, "mission.test_mass.%s.mass_kg", g->instance);
  if (config->get_f64(config->context, path, &g->mass_kg)) {
    free(g);
    return say(error, DRAGFREE_ERROR, "the mission has no such test mass");
  }
  dragfree_node_v1 made = {0};
  made.self = g;
  made.link = gain_link;
  made.process = gain_process;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 stages = {1, scale_manifest, scale_create};
static const dragfree_factory_v1 effects = {1, gain_manifest, gain_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  if (!strcmp(id, DRAGFREE_STAGE_V1)) return &stages;
  if (!strcmp(id, DRAGFREE_EFFECT_V1)) return &effects;
  return NULL;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
