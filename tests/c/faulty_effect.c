/* An effect with a memory, sound unless it is compiled with one of FAULT_...: what `plugins validate` must find. */
#include <dragfree/rows.h>
#include <math.h>
#include <stdio.h>

typedef struct {
  char instance[8];
  dragfree_slot_v1 x;
  double mean; /* a running mean of the displacement */
  double calls;
} effect;

static const char *effect_manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"faulty\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"Faulty where it is told to be\","
         "\"instances\":[\"tm1\",\"tm2\"],\"parameters\":[{\"name\":\"weight\",\"type\":\"f64\",\"default\":0.01,"
#ifndef FAULT_UNITLESS
         "\"unit\":\"1\","
#endif
         "\"help\":\"weight of a new sample\"}]}";
}

static dragfree_status effect_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  effect *e = self;
  char name[64], text[256], attributes[256], table[64];
  double rate_hz = 0.0;
  for (uint32_t i = 0; i < link->available_count; i++) rate_hz = fmax(rate_hz, link->available[i].rate_hz);
  snprintf(name, sizeof name, "is.%s.r_orf_m.y", e->instance);
  dragfree_column_v1 want = {"grid", name, "m", NULL, 0.0, NULL};
  if (link->read(link->context, &want, &e->x)) return say(error, DRAGFREE_ERROR, "no displacement");
#ifdef FAULT_NAMELESS
  snprintf(name, sizeof name, "anything.%s", e->instance);
#else
  snprintf(name, sizeof name, "faulty.%s", e->instance);
#endif
  snprintf(text, sizeof text,
           "{\"name\":\"%s\",\"unit\":\"s-2\",\"frame\":\"\",\"lower\":-1.0,\"upper\":1.0,\"initial\":0.0,\"prior_sigma\":1.0}", name);
  if (link->coefficient(link->context, text)) return say(error, DRAGFREE_ERROR, "coefficient refused");
  snprintf(table, sizeof table, "effect/faulty:%s", e->instance);
  snprintf(attributes, sizeof attributes, "{\"kind\":\"regressor\",\"coefficient\":\"%s\",\"channel\":\"%s.accel.y\"}", name, e->instance);
  dragfree_column_v1 regressor = {table, "mean", "m", "", rate_hz, attributes};
  return link->write(link->context, &regressor);
}

static dragfree_status effect_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                      dragfree_error_v1 *error) {
  effect *e = self;
  const struct ArrowArray *table = &inputs->tables[e->x.table];
  const double *x = input(table, e->x.column);
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *mean = column(&outputs[0], 0);
#ifdef FAULT_CRASH
  *(volatile int *)(intptr_t)8 = 1;
#endif
#ifdef FAULT_BATCH
  e->mean = 0.0;
#endif
#ifdef FAULT_REPLAY
  static double ever = 0.0;
  e->calls = ever += 1e-12;
#endif
  for (int64_t k = 0; k < table->length; k++) {
    if (isfinite(x[k])) e->mean += 0.01 * (x[k] - e->mean);
    mean[k] = e->mean + e->calls;
#ifdef FAULT_INFINITE
    if (k == 3) mean[k] = INFINITY;
#endif
  }
  return DRAGFREE_OK;
}

static dragfree_status effect_save(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error) {
  (void)error;
  effect *e = self;
  return writer->write(writer->context, (const uint8_t *)&e->mean, sizeof e->mean);
}

static dragfree_status effect_load(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error) {
  effect *e = self;
  (void)error;
#ifndef FAULT_GARBAGE
  if (length != sizeof e->mean) return say(error, DRAGFREE_ERROR, "no state of faulty");
#endif
  memcpy(&e->mean, bytes, length < sizeof e->mean ? length : sizeof e->mean);
#ifdef FAULT_STATE
  /* The bytes come back as they were, but what follows does not. */
  e->calls = 1e-9;
#endif
  return DRAGFREE_OK;
}

static dragfree_status effect_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                     dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
#ifdef FAULT_EXITS
  exit(0);
#endif
  effect *e = calloc(1, sizeof *e);
  const char *instance = NULL;
  if (!e) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_text(config->context, "instance", &instance) || strlen(instance) >= sizeof e->instance) {
    free(e);
    return say(error, DRAGFREE_ERROR, "no instance");
  }
  strcpy(e->instance, instance);
  dragfree_node_v1 made = {0};
  made.self = e;
  made.link = effect_link;
  made.process = effect_process;
  made.save = effect_save;
  made.load = effect_load;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 effects = {1, effect_manifest, effect_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_EFFECT_V1) ? NULL : &effects;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
