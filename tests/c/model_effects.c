/* Effect `c-es-crosstalk` in plain C: electrostatic force along y that also pushes along x, F_y / m_m per unit. */
#include <dragfree/rows.h>
#include <math.h>
#include <stdio.h>

typedef struct {
  double mass_kg;
  double scale;
  char body[4];
  dragfree_slot_v1 force;
} crosstalk;

static const char *manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"c-es-crosstalk\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"Cross-talk in C\","
         "\"instances\":[\"tm1.y-x\",\"tm2.y-x\"],\"parameters\":[{\"name\":\"scale\",\"type\":\"f64\",\"unit\":\"1\","
         "\"default\":1.0,\"minimum\":0.5,\"maximum\":10.0,\"help\":\"units of the coefficient\"}]}";
}

static dragfree_status link_columns(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  crosstalk *c = self;
  char name[64], text[256], attributes[256], table[64];
  double rate_hz = 0.0;
  for (uint32_t i = 0; i < link->available_count; i++) rate_hz = fmax(rate_hz, link->available[i].rate_hz);
  snprintf(name, sizeof name, "command.%s.force_orf_n.y", c->body);
  dragfree_column_v1 want = {"grid", name, "N", NULL, 0.0, NULL};
  if (link->read(link->context, &want, &c->force)) return say(error, DRAGFREE_ERROR, "no commanded force");
  snprintf(text, sizeof text,
           "{\"name\":\"c-es-crosstalk.%s.y-x\",\"unit\":\"1\",\"frame\":\"\",\"lower\":-0.5,\"upper\":0.5,\"initial\":0.0,"
           "\"prior_sigma\":0.3}",
           c->body);
  if (link->coefficient(link->context, text)) return say(error, DRAGFREE_ERROR, "coefficient refused");
  snprintf(name, sizeof name, "c-es-crosstalk.%s.y-x@%s.accel.x", c->body, c->body);
  snprintf(table, sizeof table, "effect/c-es-crosstalk:%s.y-x", c->body);
  snprintf(attributes, sizeof attributes,
           "{\"kind\":\"regressor\",\"coefficient\":\"c-es-crosstalk.%s.y-x\",\"channel\":\"%s.accel.x\"}", c->body, c->body);
  dragfree_column_v1 regressor = {table, name, "m s-2", "", rate_hz, attributes};
  return link->write(link->context, &regressor);
}

static dragfree_status process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                               dragfree_error_v1 *error) {
  crosstalk *c = self;
  const struct ArrowArray *table = &inputs->tables[c->force.table];
  const double *force = input(table, c->force.column);
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *regressor = column(&outputs[0], 0);
  for (int64_t i = 0; i < table->length; i++) regressor[i] = c->scale * force[i] / c->mass_kg;
  return DRAGFREE_OK;
}

static dragfree_status create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                              dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  crosstalk *c = calloc(1, sizeof *c);
  const char *instance = NULL;
  char path[64];
  if (!c) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_text(config->context, "instance", &instance) || strlen(instance) < 4 ||
      config->get_f64(config->context, "parameters.scale", &c->scale)) {
    free(c);
    return say(error, DRAGFREE_ERROR, "no instance or no scale");
  }
  memcpy(c->body, instance, 3); /* "tm1", ended by calloc's zero */
  snprintf(path, sizeof path, "mission.test_mass.%s.mass_kg", c->body);
  if (config->get_f64(config->context, path, &c->mass_kg)) {
    free(c);
    return say(error, DRAGFREE_ERROR, "the mission has no such test mass");
  }
  dragfree_node_v1 made = {0};
  made.self = c;
  made.link = link_columns;
  made.process = process;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 effects = {1, manifest, create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_EFFECT_V1) ? NULL : &effects;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
