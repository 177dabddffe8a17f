/* Source `{{NAME}}`: telemetry that is no file of ours; here a housekeeping channel that climbs by a kelvin a day.
 *
 * The lines to change for another source are marked with CHANGE. */
#include <dragfree/rows.h>

/* CHANGE: time from row to row, ns. */
#define STEP_NS 10000000000LL

typedef struct {
  double slope_k_s;
  int64_t first_ns, next_ns, end_ns;
} source;

static const char *source_manifest(uint32_t index) {
  (void)index;
  /* CHANGE: the description; every parameter with unit, default, range and help: a pipeline that gives another key
   * is refused. */
  return "{\"id\":\"{{NAME}}\",\"version\":\"0.1.0\",\"licence\":\"MIT OR Apache-2.0\","
         "\"description\":\"A temperature that climbs\",\"parameters\":["
         "{\"name\":\"slope_k_s\",\"type\":\"f64\",\"unit\":\"K s-1\",\"default\":1.2e-5,\"minimum\":-1.0,\"maximum\":1.0,"
         "\"help\":\"how fast the temperature climbs\"}]}";
}

static dragfree_status source_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  (void)self;
  (void)error;
  /* CHANGE: tables are called as the topics of the telemetry, `is`, `dws`, `hk/NAME`, their columns as its fields;
   * rate 0 is rows as they come. */
  dragfree_column_v1 value = {"hk/example_temperature_k", "value", "K", "", 0.0, NULL};
  return link->write(link->context, &value);
}

static dragfree_status source_next(void *self, uint32_t rows, struct ArrowArray *outputs, dragfree_progress_v1 *progress,
                                   dragfree_error_v1 *error) {
  source *s = self;
  int64_t left = s->next_ns < s->end_ns ? (s->end_ns - s->next_ns + STEP_NS - 1) / STEP_NS : 0;
  int64_t count = left < (int64_t)rows ? left : (int64_t)rows;
  int64_t *times = malloc(count ? (size_t)count * sizeof *times : sizeof *times);
  if (!times) return say(error, DRAGFREE_FATAL, "no memory");
  for (int64_t k = 0; k < count; k++) times[k] = s->next_ns + k * STEP_NS;
  int made = make_table(&outputs[0], times, count, 1);
  /* CHANGE: the values, NaN for none. */
  for (int64_t k = 0; made && k < count; k++)
    column(&outputs[0], 0)[k] = 293.0 + s->slope_k_s * 1e-9 * (double)(times[k] - s->first_ns);
  free(times);
  if (!made) return say(error, DRAGFREE_FATAL, "no memory");
  s->next_ns += count * STEP_NS;
  progress->done = s->next_ns >= s->end_ns;
  progress->complete_until_ns = progress->done ? s->end_ns : s->next_ns;
  return DRAGFREE_OK;
}

static dragfree_status source_save(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error) {
  (void)error;
  source *s = self;
  return writer->write(writer->context, (const uint8_t *)&s->next_ns, sizeof s->next_ns);
}

static dragfree_status source_load(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error) {
  source *s = self;
  if (length != sizeof s->next_ns) return say(error, DRAGFREE_ERROR, "the bytes are no state of {{NAME}}");
  memcpy(&s->next_ns, bytes, length);
  return DRAGFREE_OK;
}

static dragfree_status source_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                     dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  double start_ns, end_ns;
  source *s = calloc(1, sizeof *s);
  if (!s) return say(error, DRAGFREE_ERROR, "no memory");
  /* A double holds today's nanoseconds to 256 of them: begin and end on a whole second. */
  if (config->get_f64(config->context, "start_ns", &start_ns) || config->get_f64(config->context, "end_ns", &end_ns) ||
      config->get_f64(config->context, "parameters.slope_k_s", &s->slope_k_s)) {
    free(s);
    return say(error, DRAGFREE_ERROR, "no start or no end: give --from and --until");
  }
  s->first_ns = s->next_ns = (int64_t)(start_ns * 1e-9 + 0.5) * 1000000000LL;
  s->end_ns = (int64_t)(end_ns * 1e-9 + 0.5) * 1000000000LL;
  dragfree_node_v1 made = {0};
  made.self = s;
  made.link = source_link;
  made.next = source_next;
  made.save = source_save;
  made.load = source_load;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 sources = {1, source_manifest, source_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_SOURCE_V1) ? NULL : &sources;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
