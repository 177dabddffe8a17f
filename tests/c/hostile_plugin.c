/* A stage that breaks the rules in one of many ways, chosen when it runs by the environment variable HOSTILE, as
 * PHASE_WAY. The host must say which plugin did what, end with failure in time, and archive nothing. A process of its
 * own has no environment but LD_LIBRARY_PATH. */
#define _GNU_SOURCE
#include <dragfree/rows.h>
#include <fcntl.h>
#include <fenv.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

static const char *kind(void) {
  const char *chosen = getenv("HOSTILE");
  if (!chosen) chosen = getenv("LD_LIBRARY_PATH");
  return chosen ? chosen : "";
}

/* Whether this is the chosen way. */
static int is(const char *way) { return !strcmp(kind(), way); }

/* The chosen way within a phase, NULL in another one. */
static const char *way_of(const char *phase) {
  size_t length = strlen(phase);
  return strncmp(kind(), phase, length) || kind()[length] != '_' ? NULL : kind() + length + 1;
}

static void *exit_in_a_thread(void *unused) {
  (void)unused;
  exit(0);
}

static void *crash_in_a_thread(void *unused) {
  (void)unused;
  *(volatile int *)(intptr_t)8 = 1;
  return NULL;
}

static void in_a_thread(void *(*work)(void *)) {
  pthread_t thread;
  if (!pthread_create(&thread, NULL, work, NULL)) pthread_join(thread, NULL);
}

static int overflow(volatile int depth) {
  volatile char frame[4096];
  frame[0] = (char)depth;
  return depth < 0 ? 0 : overflow(depth + 1) + frame[0];
}

/* What can be done wrong in every phase. */
static void misbehave(const char *phase) {
  const char *way = way_of(phase);
  if (!way) return;
  if (!strcmp(way, "exit")) exit(0);
  if (!strcmp(way, "exit_at_once")) _exit(0);
  if (!strcmp(way, "quick_exit")) quick_exit(0);
  if (!strcmp(way, "exit_in_a_thread")) in_a_thread(exit_in_a_thread);
  /* Who waits says so. */
  if (!strcmp(way, "wait")) {
    fputs("it waits\n", stderr);
    for (;;) sleep(1);
  }
  if (!strcmp(way, "hang"))
    for (;;) sleep(1);
  if (!strcmp(way, "spin"))
    for (volatile unsigned i = 0;; i++) {
    }
  if (!strcmp(way, "segv")) *(volatile int *)(intptr_t)8 = 1;
  if (!strcmp(way, "segv_in_a_thread")) in_a_thread(crash_in_a_thread);
  if (!strcmp(way, "abort")) abort();
  if (!strcmp(way, "trap")) __builtin_trap();
  if (!strcmp(way, "stack")) overflow(0);
  if (!strcmp(way, "rounding")) fesetround(FE_UPWARD);
  if (!strcmp(way, "flush_to_zero")) {
#if defined(__x86_64__)
    unsigned word;
    __asm__ volatile("stmxcsr %0" : "=m"(word));
    word |= 0x8040;
    __asm__ volatile("ldmxcsr %0" : : "m"(word));
#else
    fesetround(FE_UPWARD);
#endif
  }
}

static volatile int escaped;

static void escape(int signal) {
  (void)signal;
  if (open("escaped", O_WRONLY | O_CREAT, 0600) >= 0) escaped = 1;
}

/* Whether a thread that was there before the plugin may do what the plugin may not. */
static int other_threads_reach(void) {
  struct sigaction action = {.sa_handler = escape};
  sigaction(SIGUSR1, &action, NULL);
  for (pid_t thread = getpid(); thread < getpid() + 4096; thread++) syscall(SYS_tgkill, getpid(), thread, SIGUSR1);
  usleep(200000);
  return escaped;
}

/* Whether it reaches what a plugin that is not trusted must not reach. */
static int reaches(void) {
  if (is("process_reaches_by_a_thread")) return other_threads_reach();
  if (is("process_touches")) return utimensat(AT_FDCWD, ".", NULL, 0) == 0 || chmod(".", 0700) == 0;
  if (is("process_reads")) return open("/etc/passwd", O_RDONLY) >= 0;
  if (is("process_lists")) return open("/", O_RDONLY | O_DIRECTORY) >= 0;
  if (is("process_writes")) return open("escaped", O_WRONLY | O_CREAT, 0600) >= 0;
  if (is("process_connects")) return socket(AF_INET, SOCK_STREAM, 0) >= 0;
  if (is("process_speaks")) return socket(AF_UNIX, SOCK_STREAM, 0) >= 0;
  if (is("process_starts")) return system("true") == 0;
  if (is("process_signals")) return kill(getppid(), 0) == 0 || syscall(SYS_tgkill, getppid(), getppid(), 0) == 0;
  if (is("process_takes_memory")) return malloc((size_t)8 << 30) != NULL;
  if (is("process_raises_limits")) {
    struct rlimit limit = {16, 16};
    return setrlimit(RLIMIT_NOFILE, &limit) == 0;
  }
  if (is("process_forks")) {
    pid_t child = fork();
    if (!child) syscall(SYS_exit_group, 0);
    return child > 0 && waitpid(child, NULL, 0) == child;
  }
  return 0;
}

/* Statuses and messages that are none. */
static dragfree_status failing(const char *phase, dragfree_error_v1 *error) {
  const char *way = way_of(phase);
  if (!way) return DRAGFREE_OK;
  if (!strcmp(way, "error")) return say(error, DRAGFREE_ERROR, "does not want to");
  if (!strcmp(way, "fatal")) return say(error, DRAGFREE_FATAL, "does not want to");
  if (!strcmp(way, "silent")) return DRAGFREE_ERROR;
  if (!strcmp(way, "status")) return 99;
  if (!strcmp(way, "negative_status")) return INT32_MIN;
  if (!strcmp(way, "endless_message")) {
    memset(error->text, 'm', error->capacity);
    return DRAGFREE_ERROR;
  }
  if (!strcmp(way, "binary_message")) return say(error, DRAGFREE_ERROR, "\x1b[2J\x1b]0;mine\x07 \xff\xfe");
  return DRAGFREE_OK;
}

__attribute__((constructor)) static void begin(void) { misbehave("open"); }

/* ---- manifests ---- */

static char *repeated(const char *start, char c, size_t count, const char *end) {
  char *text = malloc(strlen(start) + count + strlen(end) + 1);
  if (!text) abort();
  strcpy(text, start);
  memset(text + strlen(start), c, count);
  strcpy(text + strlen(start) + count, end);
  return text;
}

static const char *manifest(uint32_t index) {
  (void)index;
  misbehave("manifest");
  if (is("manifest_null")) return NULL;
  if (is("manifest_empty")) return "";
  if (is("manifest_no_json")) return "{";
  if (is("manifest_array")) return "[]";
  if (is("manifest_deep")) return repeated("", '[', 200000, "");
  if (is("manifest_huge")) return repeated("\"", 'x', 8u << 20, "\"");
  if (is("manifest_no_utf8")) return "{\"id\":\"\xff\xff\"}";
  if (is("manifest_empty_id")) return "{\"id\":\"\",\"version\":\"1\",\"licence\":\"MIT\",\"description\":\"d\"}";
  if (is("manifest_wrong_type")) return "{\"id\":7}";
  return "{\"id\":\"hostile\",\"version\":\"1.0.0\",\"licence\":\"MIT\",\"description\":\"misbehaves\"}";
}

/* ---- link ---- */

typedef struct {
  dragfree_slot_v1 x;
  double rate_hz;
  const dragfree_host_v1 *host;
} hostile;

static void many_lines(const hostile *s) {
  char *line = repeated("", 'l', 100000, "");
  for (int i = 0; i < 20000; i++) s->host->log(s->host->context, DRAGFREE_LOG_WARN, "again");
  s->host->log(s->host->context, DRAGFREE_LOG_WARN, line);
  s->host->log(s->host->context, 77, NULL);
  s->host->log(NULL, DRAGFREE_LOG_WARN, line);
  free(line);
}

static dragfree_status link_many(const dragfree_link_v1 *link, double rate_hz) {
  char name[32];
  for (int i = 0; i < 100000; i++) {
    snprintf(name, sizeof name, "c%d", i);
    dragfree_column_v1 column = {"many", name, "m", "ORF_1", rate_hz, NULL};
    dragfree_status status = link->write(link->context, &column);
    if (status) return status;
  }
  return DRAGFREE_OK;
}

static dragfree_status hostile_link(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error) {
  hostile *s = self;
  misbehave("link");
  dragfree_status failed = failing("link", error);
  if (failed) return failed;
  if (is("link_log")) many_lines(s);
  dragfree_column_v1 want = {"grid", "is.tm1.r_orf_m.y", "m", "ORF_1", 0.0, NULL};
  for (uint32_t i = 0; i < link->available_count; i++)
    if (!strcmp(link->available[i].table, "grid")) s->rate_hz = link->available[i].rate_hz;
  if (is("link_null_wanted")) return link->read(link->context, NULL, &s->x) ? say(error, 2, "no column") : 0;
  if (is("link_null_slot")) return link->read(link->context, &want, NULL);
  if (is("link_nameless")) want.name = NULL;
  if (is("link_unknown")) want.name = "is.tm1.r_orf_m.w";
  if (is("link_unit")) want.unit = "mm";
  if (is("link_frame")) want.frame = "CRF";
  if (is("link_rate")) want.rate_hz = 3.0;
  if (is("link_long_wanted")) want.name = repeated("", 'n', 100000, "");
  if (link->read(link->context, &want, &s->x)) return say(error, DRAGFREE_ERROR, "no column");
  dragfree_column_v1 copy = {"hostile", "hostile.y", "m", "ORF_1", s->rate_hz, "{\"archive\":\"true\"}"};
  if (is("link_null_column")) return link->write(link->context, NULL) ? say(error, 2, "no column") : 0;
  if (is("link_no_table")) copy.table = NULL;
  if (is("link_no_name")) copy.name = "";
  if (is("link_long_name")) copy.name = repeated("", 'n', 100000, "");
  if (is("link_long_unit")) copy.unit = repeated("", 'u', 100000, "");
  if (is("link_nan_rate")) copy.rate_hz = NAN;
  if (is("link_infinite_rate")) copy.rate_hz = INFINITY;
  if (is("link_negative_rate")) copy.rate_hz = -1.0;
  if (is("link_existing_table")) copy.table = "grid";
  if (is("link_existing_column")) copy.table = "grid", copy.name = want.name;
  if (is("link_attributes")) copy.attributes = "{\"archive\":";
  if (is("link_deep_attributes")) copy.attributes = repeated("{\"a\":", '[', 200000, "");
  if (is("link_huge_attributes")) copy.attributes = repeated("{\"a\":\"", 'a', 8u << 20, "\"}");
  if (is("link_noise"))
    copy.attributes = "{\"noise_processes\":[{\"name\":\"n\",\"unit\":\"m\",\"spectrum\":[],\"enters\":{\"no\":[1]}}]}";
  if (is("link_coefficient")) return link->coefficient(link->context, "{\"name\":\"hostile.a\",\"unit\":\"m\"}");
  if (is("link_constraint")) return link->constraint(link->context, NULL);
  if (is("link_many")) return link_many(link, s->rate_hz);
  dragfree_status status = link->write(link->context, &copy);
  if (!status && is("link_twice")) status = link->write(link->context, &copy);
  if (!status && is("link_two_rates")) {
    copy.name = "hostile.z", copy.rate_hz = 1.0;
    status = link->write(link->context, &copy);
  }
  return status;
}

static dragfree_status hostile_activate(void *self, uint32_t max_rows, dragfree_error_v1 *error) {
  (void)self;
  (void)max_rows;
  misbehave("activate");
  return failing("activate", error);
}

/* ---- process ---- */

static void release_badly(struct ArrowArray *array) {
  misbehave("release");
  release_table(array);
}

/* Of a spoilt table, which nobody can walk any more. */
static void keep(struct ArrowArray *array) { array->release = NULL; }

/* A sound table, made unsound. What it owned stays where it is. */
static void spoil(struct ArrowArray *table) {
  static struct ArrowArray *children[2];
  struct ArrowArray *first = table->children[0], *second = table->children[1];
  const int64_t huge = (int64_t)1 << 60;
  children[0] = first, children[1] = second;
  if (is("process_huge_length")) table->length = first->length = second->length = huge;
  if (is("process_largest_length")) table->length = first->length = second->length = INT64_MAX;
  if (is("process_negative_length")) table->length = -1;
  if (is("process_longer")) table->length += 1;
  if (is("process_offset")) table->offset = 1;
  if (is("process_huge_offset")) table->offset = huge, first->length = second->length = INT64_MAX;
  if (is("process_largest_offset")) table->offset = INT64_MAX, first->length = second->length = INT64_MAX;
  if (is("process_negative_offset")) table->offset = -8;
  if (is("process_child_huge_offset")) second->offset = huge;
  if (is("process_child_largest_offset")) second->offset = INT64_MAX;
  if (is("process_child_negative_offset")) second->offset = -1;
  if (is("process_child_shorter")) second->length -= 1;
  if (is("process_child_negative_length")) second->length = INT64_MIN;
  if (is("process_child_nulls")) second->null_count = 1;
  if (is("process_child_text")) second->n_buffers = 3;
  if (is("process_child_no_buffers")) second->buffers = NULL;
  if (is("process_child_no_values")) second->buffers[1] = NULL;
  if (is("process_child_dictionary")) second->dictionary = first;
  if (is("process_child_buffers_misaligned")) second->buffers = (const void **)((char *)second->buffers + 1);
  if (is("process_child_missing")) children[1] = NULL, table->children = children;
  if (is("process_child_misaligned"))
    children[1] = (struct ArrowArray *)((char *)second + 4), table->children = children;
  if (is("process_children_none")) table->children = NULL;
  if (is("process_children_misaligned")) table->children = (struct ArrowArray **)((char *)table->children + 1);
  if (is("process_children_fewer")) table->n_children = 1;
  if (is("process_children_more")) table->n_children = 3;
  if (is("process_children_many")) table->n_children = INT64_MAX;
  if (is("process_children_negative")) table->n_children = -2;
  if (is("process_buffers")) table->n_buffers = 2;
  if (is("process_nulls")) table->null_count = 5;
  if (is("process_dictionary")) table->dictionary = first;
  if (is("process_no_release")) table->release = NULL;
  int64_t *times = (int64_t *)first->buffers[1];
  if (is("process_backwards") && table->length > 2) times[1] = times[0] - 1;
  if (is("process_equal_times") && table->length > 2) times[1] = times[0];
  if (is("process_far_past") && table->length > 2) times[2] = INT64_MIN;
}

static dragfree_status hostile_process(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                                       dragfree_error_v1 *error) {
  hostile *s = self;
  misbehave("process");
  if (reaches()) return say(error, DRAGFREE_ERROR, "reaches what it must not");
  const struct ArrowArray *table = &inputs->tables[s->x.table];
  if (!make_table(&outputs[0], input(table, -1), table->length, 1)) return say(error, DRAGFREE_FATAL, "no memory");
  memcpy(column(&outputs[0], 0), input(table, s->x.column), (size_t)table->length * 8);
  if (is("process_writes_inputs")) ((double *)(intptr_t)input(table, s->x.column))[0] = 1e30;
  if (way_of("process")) outputs[0].release = keep;
  spoil(&outputs[0]);
  if (way_of("release")) outputs[0].release = release_badly;
  return failing("process", error);
}

static dragfree_status hostile_flush(void *self, struct ArrowArray *outputs, dragfree_error_v1 *error) {
  (void)self;
  (void)outputs;
  misbehave("flush");
  if (is("flush_discard")) return DRAGFREE_DISCARD;
  return failing("flush", error);
}

/* ---- report and state ---- */

static dragfree_status write_text(const dragfree_writer_v1 *writer, const char *text) {
  return writer->write(writer->context, (const uint8_t *)text, strlen(text));
}

static dragfree_status endless(const dragfree_writer_v1 *writer) {
  char *piece = repeated("", ' ', 64u << 20, "");
  for (int i = 0; i < 100; i++)
    if (write_text(writer, piece)) break;
  free(piece);
  return DRAGFREE_OK; /* as if nothing had been said */
}

static dragfree_status hostile_report(void *self, const char *earlier, const dragfree_writer_v1 *writer,
                                      dragfree_error_v1 *error) {
  (void)self;
  (void)earlier;
  misbehave("report");
  if (is("report_huge_length")) writer->write(writer->context, (const uint8_t *)"{}", SIZE_MAX);
  if (is("report_half_length")) writer->write(writer->context, (const uint8_t *)"{}", (size_t)1 << 63);
  if (is("report_from_nowhere")) writer->write(writer->context, NULL, 5);
  if (is("report_endless")) return endless(writer);
  if (is("report_no_json")) return write_text(writer, "no json");
  if (is("report_empty")) return DRAGFREE_OK;
  if (is("report_array")) return write_text(writer, "[]");
  if (is("report_deep")) return write_text(writer, repeated("{\"quality\":", '[', 200000, ""));
  if (is("report_wrong_type")) return write_text(writer, "{\"nis\":\"good\"}");
  if (is("report_negative_count")) return write_text(writer, "{\"epochs_used\":-1}");
  if (is("report_escape"))
    return write_text(writer, "{\"attachments\":[{\"suffix\":\"../../escaped\",\"text\":\"x\"}]}");
  if (is("report_overwrites")) return write_text(writer, "{\"attachments\":[{\"suffix\":\"toml\",\"text\":\"x\"}]}");
  if (is("report_same_twice"))
    return write_text(writer, "{\"attachments\":[{\"suffix\":\"a.json\",\"text\":\"x\"},"
                              "{\"suffix\":\"a.json\",\"text\":\"y\"}]}");
  dragfree_status failed = failing("report", error);
  return failed ? failed : write_text(writer, "{}");
}

static dragfree_status hostile_save(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error) {
  (void)self;
  misbehave("save");
  if (is("save_huge_length")) writer->write(writer->context, (const uint8_t *)"s", SIZE_MAX);
  if (is("save_endless")) return endless(writer);
  dragfree_status failed = failing("save", error);
  return failed ? failed : write_text(writer, "s");
}

static dragfree_status hostile_load(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error) {
  (void)self;
  (void)bytes;
  (void)length;
  (void)error;
  return DRAGFREE_OK;
}

static void hostile_destroy(void *self) {
  misbehave("destroy");
  free(self);
}

/* ---- create ---- */

static dragfree_status hostile_create(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                                      dragfree_node_v1 *node, dragfree_error_v1 *error) {
  (void)index;
  misbehave("create");
  dragfree_status failed = failing("create", error);
  if (failed) return failed;
  double number;
  const char *text;
  if (is("create_null_path") && config->get_f64(config->context, NULL, &number)) return say(error, 2, "no path");
  if (is("create_null_place") && config->get_text(config->context, "instance", NULL)) return say(error, 2, "no place");
  if (is("create_null_context") && config->get_text(NULL, "instance", &text)) return say(error, 2, "no context");
  if (is("create_nothing")) return DRAGFREE_OK;
  hostile *s = calloc(1, sizeof *s);
  if (!s) return say(error, DRAGFREE_ERROR, "no memory");
  s->host = host;
  dragfree_node_v1 made = {0};
  made.self = s;
  made.link = is("create_no_link") ? NULL : hostile_link;
  made.activate = hostile_activate;
  made.process = is("create_no_process") ? NULL : hostile_process;
  made.flush = hostile_flush;
  made.report = hostile_report;
  made.save = hostile_save;
  made.load = hostile_load;
  made.destroy = is("create_no_destroy") ? NULL : hostile_destroy;
  *node = made;
  return DRAGFREE_OK;
}

static const dragfree_factory_v1 sound = {1, manifest, hostile_create};
static const dragfree_factory_v1 crowded = {UINT32_MAX, manifest, hostile_create};
static const dragfree_factory_v1 empty = {0, manifest, hostile_create};
static const dragfree_factory_v1 dumb = {1, NULL, hostile_create};
static const dragfree_factory_v1 barren = {1, manifest, NULL};

static const dragfree_factory_v1 *get_factory(const char *id) {
  misbehave("factory");
  if (strcmp(id, DRAGFREE_STAGE_V1)) return NULL;
  if (is("factory_crowded")) return &crowded;
  if (is("factory_empty")) return &empty;
  if (is("factory_no_manifest")) return &dumb;
  if (is("factory_no_create")) return &barren;
  if (is("factory_misaligned")) return (const dragfree_factory_v1 *)((const char *)&sound + 1);
  return &sound;
}

DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = {DRAGFREE_ABI_VERSION, 0, get_factory};
