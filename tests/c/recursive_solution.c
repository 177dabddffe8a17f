/* A stage that brings a recursive solution of its own: com-offset.tm1.y is OFFSET_M ± SIGMA_M, given with -D. */
#include <dragfree/rows.h>
#include <stdio.h>

static const char *manifest(uint32_t index) {
  (void)index;
  return "{\"id\":\"c-recursive\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"a recursive solution\"}";
}

static dragfree_status link_column(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  const dragfree_column_v1 want = {"reconstruction", "tm1.accel.y", "m s-2", "ORF_1", 0.0, NULL};
  dragfree_slot_v1 slot;
  (void)self;
  return link->read(link->context, &want, &slot) ? say(error, DRAGFREE_ERROR, "no channel tm1.accel.y") : DRAGFREE_OK;
}

static dragfree_status process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                               dragfree_error_v1 *error) {
  (void)self;
  (void)inputs;
  (void)outputs;
  (void)error;
  return DRAGFREE_OK;
}

static dragfree_status report(void *self, const char *earlier, const dragfree_writer_v1 *writer,
                              dragfree_error_v1 *error) {
  (void)self;
  (void)earlier;
  (void)error;
  char text[256];
  int n = snprintf(text, sizeof text,
                   "{\"coefficients\":[{\"name\":\"com-offset.tm1.y\",\"solution\":\"c-recursive\",\"role\":\"recursive\","
                   "\"value\":%.17g,\"sigma\":%.17g,\"unit\":\"m\",\"frame\":\"ORF_1\"}]}",
                   OFFSET_M, SIGMA_M);
  return writer->write(writer->context, (const uint8_t *)text, (size_t)n);
}

static dragfree_status create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                              dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  (void)config;
  dragfree_node_v1 made = {0};
  made.self = calloc(1, 1);
  made.link = link_column;
  made.process = process;
  made.report = report;
  made.destroy = free;
  if (!made.self) return say(error, DRAGFREE_ERROR, "no memory");
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 stages = {1, manifest, create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_STAGE_V1) ? NULL : &stages;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
