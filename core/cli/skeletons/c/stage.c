/* Stage `{{NAME}}`: a column of the grid times a factor, and how many rows it has seen.
 *
 * The lines to change for another stage are marked with CHANGE. */
#include <dragfree/rows.h>

typedef struct {
  double factor;
  dragfree_slot_v1 read;
  uint64_t rows;
} stage;

static const char *stage_manifest(uint32_t index) {
  (void)index;
  /* CHANGE: the description; every parameter with unit, default, range and help: a pipeline that gives another key
   * is refused. */
  return "{\"id\":\"{{NAME}}\",\"version\":\"0.1.0\",\"licence\":\"MIT OR Apache-2.0\","
         "\"description\":\"Scales the first test mass's displacement along y\",\"parameters\":["
         "{\"name\":\"factor\",\"type\":\"f64\",\"unit\":\"1\",\"default\":2.0,\"minimum\":-1000.0,\"maximum\":1000.0,"
         "\"help\":\"what the displacement is multiplied by\"}]}";
}

static dragfree_status stage_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  stage *s = self;
  double rate_hz = 0.0;
  for (uint32_t i = 0; i < link->available_count; i++)
    if (!strcmp(link->available[i].table, "grid")) rate_hz = link->available[i].rate_hz;
  /* CHANGE: what is read, with the unit and the frame that the stage is written for; the host refuses another. */
  dragfree_column_v1 want = {"grid", "is.tm1.r_orf_m.y", "m", "ORF_1", 0.0, NULL};
  if (link->read(link->context, &want, &s->read)) return say(error, DRAGFREE_ERROR, "no displacement");
  /* CHANGE: what is written. The attribute `archive` puts the table beside the product. */
  dragfree_column_v1 scaled = {"{{NAME}}", "tm1.scaled_orf_m.y", "m", "ORF_1", rate_hz, "{\"archive\":\"true\"}"};
  return link->write(link->context, &scaled);
}

static dragfree_status stage_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                     dragfree_error_v1 *error) {
  stage *s = self;
  const struct ArrowArray *table = &inputs->tables[s->read.table];
  const double *x = input(table, s->read.column);
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *scaled = column(&outputs[0], 0);
  /* CHANGE: the work, a value a row; it must not depend on where a batch ends. */
  for (int64_t k = 0; k < table->length; k++) scaled[k] = s->factor * x[k];
  s->rows += (uint64_t)table->length;
  return DRAGFREE_OK;
}

static dragfree_status stage_report(void *self, const char *earlier, const dragfree_writer_v1 *writer,
                                    dragfree_error_v1 *error) {
  (void)earlier;
  (void)error;
  char text[64];
  int n = snprintf(text, sizeof text, "{\"counts\":{\"rows\":%llu}}", (unsigned long long)((stage *)self)->rows);
  return writer->write(writer->context, (const uint8_t *)text, (size_t)n);
}

static dragfree_status stage_save(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error) {
  (void)error;
  /* CHANGE: everything that the next row depends on. */
  stage *s = self;
  return writer->write(writer->context, (const uint8_t *)&s->rows, sizeof s->rows);
}

static dragfree_status stage_load(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error) {
  stage *s = self;
  if (length != sizeof s->rows) return say(error, DRAGFREE_ERROR, "the bytes are no state of {{NAME}}");
  memcpy(&s->rows, bytes, length);
  return DRAGFREE_OK;
}

static dragfree_status stage_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                    dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  stage *s = calloc(1, sizeof *s);
  if (!s) return say(error, DRAGFREE_ERROR, "no memory");
  if (config->get_f64(config->context, "parameters.factor", &s->factor)) {
    free(s);
    return say(error, DRAGFREE_ERROR, "no factor");
  }
  dragfree_node_v1 made = {0};
  made.self = s;
  made.link = stage_link;
  made.process = stage_process;
  made.report = stage_report;
  made.save = stage_save;
  made.load = stage_load;
  made.destroy = free;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 stages = {1, stage_manifest, stage_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_STAGE_V1) ? NULL : &stages;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
