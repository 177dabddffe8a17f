/* Effect `{{NAME}}`: a force on a test mass that is proportional to a housekeeping channel.
 *
 * The lines to change for another cause are marked with CHANGE. */
#include <dragfree/rows.h>

/* CHANGE: the physical range of the coefficient, N per unit of the channel. The solution never leaves it, so a
 * coefficient that ends at it says that the cause is another. */
#define RANGE "1e-6"
/* CHANGE: how far from zero the coefficient is expected before any data, N per unit of the channel: one standard
 * deviation. */
#define PRIOR_SIGMA "1e-7"

typedef struct {
  char instance[40]; /* NAME.x: a test mass and an axis */
  char channel[128], reference[128];
  double mass_kg;
  dragfree_slot_v1 channel_slot, reference_slot;
} effect;

static const char *effect_manifest(uint32_t index) {
  (void)index;
  /* CHANGE: the description; every parameter with unit, default, range and help (a model that gives another key is
   * refused); where it can act, where {test_mass} stands for each test mass of the mission. */
  return "{\"id\":\"{{NAME}}\",\"version\":\"0.1.0\",\"licence\":\"MIT OR Apache-2.0\","
         "\"description\":\"Force on a test mass in proportion to a housekeeping channel\","
         "\"instances\":[\"{test_mass}.x\",\"{test_mass}.y\",\"{test_mass}.z\"],\"parameters\":["
         "{\"name\":\"channel\",\"type\":\"text\",\"default\":\"hk.battery_current_a\","
         "\"help\":\"housekeeping channel that the force follows, hk.NAME\"},"
         "{\"name\":\"reference\",\"type\":\"text\",\"default\":\"\","
         "\"help\":\"channel that is taken off it first, in the same unit; empty for none\"}]}";
}

static dragfree_status effect_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  effect *e = self;
  const char *unit = "1", *frame = "", *axis = strchr(e->instance, '.') + 1;
  double rate_hz = 0.0;
  char name[96], shown[64], column[192], text[512], attributes[256], table[96];
  /* CHANGE: the channels in which it shows, a column each. Channels hold measured minus known acceleration:
   * NAME.accel.x to NAME.accel.z of a test mass in m s-2, sc.alpha.x to sc.alpha.z in rad s-2. */
  snprintf(shown, sizeof shown, "%.*s.accel.%s", (int)(axis - 1 - e->instance), e->instance, axis);
  /* Table `grid`: what the preprocessing stage has brought onto one grid of epochs. */
  for (uint32_t i = 0; i < link->available_count; i++) {
    const dragfree_column_v1 *have = &link->available[i];
    if (!strcmp(have->name, shown)) frame = have->frame;
    if (strcmp(have->table, "grid")) continue;
    rate_hz = have->rate_hz;
    if (!strcmp(have->name, e->channel)) unit = have->unit;
  }
  dragfree_column_v1 channel = {"grid", e->channel, NULL, NULL, 0.0, NULL};
  if (link->read(link->context, &channel, &e->channel_slot)) return say(error, DRAGFREE_ERROR, "no such channel");
  dragfree_column_v1 reference = {"grid", e->reference, unit, NULL, 0.0, NULL};
  if (*e->reference && link->read(link->context, &reference, &e->reference_slot))
    return say(error, DRAGFREE_ERROR, "no such reference");

  /* A coefficient is called ID.INSTANCE, or ID.INSTANCE.NAME where an instance has several. CHANGE: its unit. */
  snprintf(name, sizeof name, "{{NAME}}.%s", e->instance);
  snprintf(text, sizeof text,
           "{\"name\":\"%s\",\"unit\":\"N (%s)-1\",\"frame\":\"%s\",\"lower\":-" RANGE ",\"upper\":" RANGE
           ",\"initial\":0.0,\"prior_sigma\":" PRIOR_SIGMA "}",
           name, unit, frame);
  if (link->coefficient(link->context, text)) return say(error, DRAGFREE_ERROR, "coefficient refused");

  snprintf(column, sizeof column, "%s@%s", name, shown);
  snprintf(table, sizeof table, "effect/{{NAME}}:%s", e->instance);
  snprintf(attributes, sizeof attributes, "{\"kind\":\"regressor\",\"coefficient\":\"%s\",\"channel\":\"%s\"}", name, shown);
  dragfree_column_v1 regressor = {table, column, "m s-2", "", rate_hz, attributes};
  return link->write(link->context, &regressor);
}

static dragfree_status effect_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                      dragfree_error_v1 *error) {
  effect *e = self;
  const struct ArrowArray *table = &inputs->tables[e->channel_slot.table];
  const double *channel = input(table, e->channel_slot.column);
  const double *reference = *e->reference ? input(table, e->reference_slot.column) : NULL;
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  double *acceleration = column(&outputs[0], 0);
  /* CHANGE: the acceleration that one unit of the coefficient adds, m s-2, one value a row: the mean from the row's
   * time to the next row's. No value of the channel, NaN, gives no value here. */
  for (int64_t k = 0; k < table->length; k++)
    acceleration[k] = (channel[k] - (reference ? reference[k] : 0.0)) / e->mass_kg;
  return DRAGFREE_OK;
}

/* A text of the configuration into `out`; 0 where there is none or where it is too long. */
static int text_into(const dragfree_config_v1 *config, const char *path, char *out, size_t capacity) {
  const char *value = NULL;
  if (config->get_text(config->context, path, &value) || strlen(value) >= capacity) return 0;
  strcpy(out, value);
  return 1;
}

static dragfree_status effect_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                     dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  char path[96];
  effect *e = calloc(1, sizeof *e);
  if (!e) return say(error, DRAGFREE_ERROR, "no memory");
  int known = text_into(config, "instance", e->instance, sizeof e->instance) && strchr(e->instance, '.') &&
              text_into(config, "parameters.channel", e->channel, sizeof e->channel) &&
              text_into(config, "parameters.reference", e->reference, sizeof e->reference);
  /* The mission file: whatever the effect needs to know of the spacecraft is there. */
  snprintf(path, sizeof path, "mission.test_mass.%.*s.mass_kg", (int)strcspn(e->instance, "."), e->instance);
  if (!known || config->get_f64(config->context, path, &e->mass_kg)) {
    free(e);
    return say(error, DRAGFREE_ERROR, "an instance NAME.x, names of channels below 128 bytes and a mission with that test mass are needed");
  }
  dragfree_node_v1 made = {0};
  made.self = e;
  made.link = effect_link;
  made.process = effect_process;
  made.destroy = free;
  /* An effect with a memory, a lag or an integral, also has `save` and `load`. */
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 effects = {1, effect_manifest, effect_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_EFFECT_V1) ? NULL : &effects;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
