/* Plugins that misbehave, each in one way chosen at compile time with -DBAD=…; the host must say what and stay alive.
 *   1 another ABI version            2 an error in mid-stream          3 discards every second batch
 *   4 asks for a column nobody makes 5 wants another unit              6 changes the rounding mode
 *   7 gives one row too few          8 fails in create                 9 a manifest that is no JSON
 *  10 a fatal error in mid-stream   11 a report with NaN and unknown keys   12 a report with a text for a number
 *  13 noise in a channel that nobody makes
 *  21 prints to stdout              22 writes to memory that is not its own
 *  23 aborts                       24 aborts in a thread of its own  25 never returns from create
 *  26 says its own name in a failure
 */
#include <dragfree/rows.h>
#include <fenv.h>
#include <pthread.h>
#include <stdio.h>
#include <unistd.h>

typedef struct {
  dragfree_slot_v1 x;
  double rate_hz;
  uint64_t calls;
} bad;

static const char *manifest(uint32_t index) {
  (void)index;
#if BAD == 9
  return "{";
#else
  return "{\"id\":\"bad\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"misbehaves\"}";
#endif
}

static dragfree_status bad_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  bad *s = self;
  dragfree_column_v1 want = {"grid", "is.tm1.r_orf_m.y", "m", "ORF_1", 0.0, NULL};
#if BAD == 4
  want.name = "is.tm1.r_orf_m.w";
#elif BAD == 5
  want.unit = "mm";
#endif
  for (uint32_t i = 0; i < link->available_count; i++)
    if (!strcmp(link->available[i].table, "grid")) s->rate_hz = link->available[i].rate_hz;
  if (link->read(link->context, &want, &s->x)) return say(error, DRAGFREE_ERROR, "no column");
  dragfree_column_v1 copy = {"bad", "bad.y", "m", "ORF_1", s->rate_hz, "{\"archive\":\"true\"}"};
#if BAD == 13
  copy.attributes = "{\"noise_processes\":[{\"name\":\"shot:bad\",\"unit\":\"m\",\"spectrum\":[{\"asd\":1e-12,"
                    "\"corner_hz\":1.0,\"exponent\":0}],\"enters\":{\"bad.y\":[1.0]},\"response\":\"direct\"}]}";
#endif
  return link->write(link->context, &copy);
}

#if BAD == 24
static void *aborting(void *unused) {
  (void)unused;
  abort();
}
#endif

static dragfree_status bad_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                   dragfree_error_v1 *error) {
  bad *s = self;
  const struct ArrowArray *table = &inputs->tables[s->x.table];
  s->calls++;
#if BAD == 2
  if (s->calls == 3) return say(error, DRAGFREE_ERROR, "the third batch is too much");
#elif BAD == 10
  if (s->calls == 3) return say(error, DRAGFREE_FATAL, "the third batch is fatal");
#elif BAD == 3
  if (s->calls % 2 == 0) return say(error, DRAGFREE_DISCARD, "not this one");
#elif BAD == 21
  printf("a plugin prints to stdout\n");
  if (write(1, "a plugin writes to descriptor 1\n", 32) != 32) return say(error, DRAGFREE_ERROR, "no stdout");
#elif BAD == 22
  *(volatile int *)(intptr_t)8 = 1;
#elif BAD == 23
  abort();
#elif BAD == 24
  pthread_t thread;
  if (!pthread_create(&thread, NULL, aborting, NULL)) pthread_join(thread, NULL);
#elif BAD == 26
  return say(error, DRAGFREE_ERROR, "bad: told twice");
#elif BAD == 6
  fesetround(FE_UPWARD);
#endif
  int64_t rows = table->length;
#if BAD == 7
  rows -= 1;
#endif
  if (!make_table(&outputs[0], input(table, -1), rows, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  memcpy(column(&outputs[0], 0), input(table, s->x.column), (size_t)rows * 8);
#if BAD == 7
  /* The table claims the rows that its columns do not have. */
  outputs[0].length = table->length;
#endif
  return DRAGFREE_OK;
}

#if BAD == 11 || BAD == 12
/* As `printf` writes it: `nan` is no JSON. */
static dragfree_status bad_report(void *self, const char *earlier, const dragfree_writer_v1 *writer,
                                  dragfree_error_v1 *error) {
  (void)self;
  (void)earlier;
  (void)error;
  char text[256];
#if BAD == 12
  int n = snprintf(text, sizeof text, "{\"nis\":\"good\"}");
#else
  int n = snprintf(text, sizeof text,
                   "{\"chi2_per_dof\":%g,\"shade\":\"blue\",\"covariance\":{\"mine\":{\"names\":[\"a\"],"
                   "\"matrix\":[[null]]}}}",
                   strtod("nan", NULL));
#endif
  return writer->write(writer->context, (const uint8_t *)text, (size_t)n);
}
#endif

static dragfree_status bad_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                  dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  (void)host;
  (void)config;
#if BAD == 25
  for (;;) sleep(1);
#endif
#if BAD == 8
  return say(error, DRAGFREE_ERROR, "this plugin never comes to life");
#endif
  dragfree_node_v1 made = {0};
  made.self = calloc(1, sizeof(bad));
  made.link = bad_link;
  made.process = bad_process;
#if BAD == 11 || BAD == 12
  made.report = bad_report;
#endif
  made.destroy = free;
  if (!made.self) return say(error, DRAGFREE_ERROR, "no memory");
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 stages = {1, manifest, bad_create};

static const dragfree_factory_v1 *get_factory(const char *id) {
  return strcmp(id, DRAGFREE_STAGE_V1) ? NULL : &stages;
}

#if BAD == 1
#define VERSION (DRAGFREE_ABI_VERSION + 1u)
#else
#define VERSION DRAGFREE_ABI_VERSION
#endif

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {VERSION, 0, get_factory};
