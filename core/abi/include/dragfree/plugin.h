/* dragfree/plugin.h - the border between the dragfree host and a plugin.
 *
 * A plugin is a shared library that exports ONE data symbol, `dragfree_entry`, and hides everything else. Data cross
 * as Apache Arrow's C Data Interface (struct arrays of int64 times and float64 columns), so a plugin may be written in
 * C, C++, Rust or anything that reads Arrow.
 *
 * Rules that never change:
 *  - a published struct never changes its layout; a new ability is a new factory id or a new revision of one;
 *  - all strings are UTF-8 and end with NUL; a `const char *` that a function receives is valid during that call only,
 *    unless its comment says more;
 *  - who creates, frees: an instance is freed by its own `destroy`, an Arrow array by its own `release`;
 *  - no exception, panic or longjmp leaves a plugin;
 *  - every function is called on one thread at a time for a given instance, though not always on the same thread;
 *    different instances may be called at the same time on different threads;
 *  - the host never unloads a library.
 *
 * What crosses as JSON (manifests, coefficients, constraints, noise processes, reports) has JSON Schemas in the folder
 * dragfree/schema beside this header, with every key and its meaning. JSON has neither NaN nor infinity: write null.
 * In a declaration an unknown key is refused; in a report it is left out and noted in the product.
 *
 * Life of an instance, with the functions that may be called in each state:
 *
 *   created --link--> linked --activate--> active --flush--> flushed --report--> reported
 *   `destroy` in any state; `process`, `next`, `save` in `active`; `load` in `active`, before the first `process`
 *   or `next`. After DRAGFREE_FATAL no function but `destroy` is called; the same holds after DRAGFREE_ERROR,
 *   where the host may make a fresh instance and `load` its last snapshot.
 */
#ifndef DRAGFREE_PLUGIN_H
#define DRAGFREE_PLUGIN_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define DRAGFREE_ABI_VERSION 1u

/* Factory ids; the number after the slash is the revision. */
#define DRAGFREE_SOURCE_V1 "dragfree.source/1"
#define DRAGFREE_STAGE_V1 "dragfree.stage/1"
#define DRAGFREE_EFFECT_V1 "dragfree.effect/1"

/* What a call came to. */
typedef int32_t dragfree_status;
#define DRAGFREE_OK 0      /* done */
#define DRAGFREE_DISCARD 1 /* this batch gives nothing; the instance is as before the call, go on */
#define DRAGFREE_ERROR 2   /* failed; only a snapshot can bring the instance back */
#define DRAGFREE_FATAL 3   /* failed; never call this instance again */

/* The Arrow C Data Interface, as its specification prints it. */
#ifndef ARROW_C_DATA_INTERFACE
#define ARROW_C_DATA_INTERFACE
#define ARROW_FLAG_DICTIONARY_ORDERED 1
#define ARROW_FLAG_NULLABLE 2
#define ARROW_FLAG_MAP_KEYS_SORTED 4
struct ArrowSchema {
  const char *format;
  const char *name;
  const char *metadata;
  int64_t flags;
  int64_t n_children;
  struct ArrowSchema **children;
  struct ArrowSchema *dictionary;
  void (*release)(struct ArrowSchema *);
  void *private_data;
};
struct ArrowArray {
  int64_t length;
  int64_t null_count;
  int64_t offset;
  int64_t n_buffers;
  int64_t n_children;
  const void **buffers;
  struct ArrowArray **children;
  struct ArrowArray *dictionary;
  void (*release)(struct ArrowArray *);
  void *private_data;
};
#endif

/* Where a failing call says what, where, why and what to do next. The caller owns `text`; the plugin writes at most
 * `capacity` bytes, the last of them NUL. */
typedef struct dragfree_error_v1 {
  char *text;
  size_t capacity;
} dragfree_error_v1;

/* Takes bytes from a plugin: a report, a state. `write` may be called any number of times; any status but
 * DRAGFREE_OK means stop and return that status. Valid during the call that received it. */
typedef struct dragfree_writer_v1 {
  void *context;
  dragfree_status (*write)(void *context, const uint8_t *bytes, size_t length);
} dragfree_writer_v1;

#define DRAGFREE_LOG_ERROR 1
#define DRAGFREE_LOG_WARN 2
#define DRAGFREE_LOG_INFO 3
#define DRAGFREE_LOG_DEBUG 4

/* What the host offers. Valid as long as the instance that was created with it. Any thread, any state. */
typedef struct dragfree_host_v1 {
  void *context;
  void (*log)(void *context, int32_t level, const char *message);
} dragfree_host_v1;

/* The configuration of an instance, valid during `create` only. `json` is one object: `parameters` (every declared
 * parameter, checked, defaults filled in), `mission` (the mission file), `instance` (effects), `candidate` (effects:
 * true where the effect is not in the model and a diagnosis tries it), `needs` (stages: what effects of the model ask
 * for in their manifests; a stage that knows how to make one of these makes it), `settings` (thresholds of the
 * pipeline, or their defaults; schema/settings lists them), `threads` (how many an instance may
 * use, itself included; results must not depend on it), `files`, `start_ns`, `end_ns` (sources), `start_ns` (stages
 * and effects: first time of the product, where rows before it come in that only settle what goes on with them).
 * The getters walk it by dotted path, "parameters.gain", "mission.spacecraft.mass_kg", so that plain C needs no JSON
 * parser; DRAGFREE_ERROR where there is no such number or string. A string from `get_text` is valid during `create`. */
typedef struct dragfree_config_v1 {
  void *context;
  const char *json;
  dragfree_status (*get_f64)(void *context, const char *path, double *value);
  dragfree_status (*get_text)(void *context, const char *path, const char **value);
} dragfree_config_v1;

/* A column: what it is called and what it means. */
typedef struct dragfree_column_v1 {
  const char *table;      /* "grid"; NULL in `read`: the uniform table that has the name, or else the irregular one */
  const char *name;       /* "is.tm1.r_orf_m.x" */
  const char *unit;       /* "m"; NULL in `read`: any */
  const char *frame;      /* "ORF_1", "" for none; NULL in `read`: any */
  double rate_hz;         /* rate of a uniform table, 0 for an irregular one; in `read` 0 is any */
  const char *attributes; /* a JSON object of strings, {"kind":"channel"}; NULL for none. A series that you make from
                           * commands has "in_loop":"true" */
} dragfree_column_v1;

/* A channel (attribute `kind` = `channel`) is a measured minus a known acceleration. `average` is "2" for one that is
 * made of second differences of a displacement, which sees the mean of two samples of an acceleration, and "1" for one
 * that is measured as it is.
 *
 * The stage that makes channels declares the noise in them: with any column that it writes, the attribute
 * `noise_processes`, no string but a JSON array of objects:
 *   {"name":"gauge","unit":"m","spectrum":[{"asd":1e-12,"corner_hz":1.0,"exponent":0}],"response":"differenced",
 *    "enters":{"gauge.x":[1.0]}}
 * `spectrum` is the one-sided power spectral density, the sum of asd^2 (corner_hz/f)^exponent, exponents even; null
 * where nobody knows it. `response` is how the channels see the process: "held", an acceleration constant over each
 * sample and seen as the mean of two (power response cos^2(pi f dt)); "differenced", a displacement's readout
 * differenced twice ((4 sin^2(pi f dt)/dt^2)^2); "direct", as it is. `enters` gives each channel's gains, one for each
 * component of the process; `covariance` correlates the components; `components` names those whose level may be
 * measured. `estimate` is for a stage that takes a quantity driven by the process from its minimum-variance estimate,
 * whose error enters channels: {"matrix":[[...]],"readout":[...],"readout_response": "differenced","enters":{...}}.
 * All keys: schema/noise_process.schema.json. A channel without declared noise starts as white, and its level is
 * measured from the residuals. Later stages find all declarations in `model_json`. */

/* Where a column that was asked for will be: `inputs->tables[table].children[1 + column]`; child 0 are the times. */
typedef struct dragfree_slot_v1 {
  uint32_t table;
  uint32_t column;
} dragfree_slot_v1;

/* The host's side of `link`, valid during that call. A plugin looks at what there is, asks for what it needs and says
 * what it makes. The host checks unit, frame and rate at once and keeps the sentence: return the status that a
 * callback gave. Written tables are numbered in the order in which their names first appear in `write`, columns in the
 * order of the calls; that is the order of the arrays that `process` fills. All columns of a table have one rate. */
typedef struct dragfree_link_v1 {
  void *context;
  uint32_t available_count;
  const dragfree_column_v1 *available;
  /* {"coefficients":[…],"constraints":[…],"noise":[…]}: what was declared up to here; schema/model. */
  const char *model_json;
  dragfree_status (*read)(void *context, const dragfree_column_v1 *wanted, dragfree_slot_v1 *slot);
  dragfree_status (*write)(void *context, const dragfree_column_v1 *column);
  /* Effects only; schema/coefficient and schema/constraint have all keys.
   *
   * A coefficient: {"name":"my-force.tm1.y","unit":"N A-1","frame":"ORF_1","lower":-1e-9,"upper":1e-9,"initial":0.0,
   * "prior_sigma":null}. Its name is EFFECT.INSTANCE, or EFFECT.INSTANCE.NAME where there are several. How channels
   * respond to it is said in one of these ways:
   *  - a written column with the attributes {"kind":"regressor","coefficient":"my-force.tm1.y",
   *    "channel":"tm1.accel.y"}: what one unit of the coefficient adds to the channel;
   *  - "responses":[{"channel":"tm1.accel.y","table":"effect/my-force:tm1","series":"current","factor":0.51}]: a
   *    factor times a series, a column with the attribute kind = series of this effect or of one before it, and with
   *    "times":"com-offset.tm1.x" times the value of another coefficient;
   *  - "noise":"thruster_force:sc.x": it multiplies the amplitude of a noise process, 1 for the declared level;
   *  - "colours":{"process":"thruster_force:sc.x","numerator":[0,0,1],"denominator":[0.4,0.06,1]}, beside responses:
   *    what follows the commands follows the actuators' noise too, whose power it makes |1 + cH(s)|^2 times as large;
   *    polynomials in s, the constant first.
   * A candidate (`candidate` of the configuration) declares what it may be in place of what it is:
   *  - "variants":[{"shape":{"lag_s":45.0},"responses":[…],"unit":"N K-1","range":[-1,1],"colours":{…}}]: one for
   *    each form; `shape` are the parameters that give the effect this form in a model; unit, range and colours where
   *    they are not the coefficient's own;
   *  - "transients":[{"shape":{"decay_s":3.0},"kernel":[0.0,0.6,0.4],"channels":[["tm1.accel.x",1.0]]}]: courses of
   *    short duration, a mean per sample from the one in which it begins; the host finds the time and gives it as the
   *    parameter `at_ns`.
   * An effect with a parameter `fine` (0 or 1) is asked again about the shape that stood out, for variants near it.
   *
   * A constraint, lower <= sum of weights times coefficients <= upper: {"name":"baseline.x","kind":"survey","terms":
   * [["com-offset.tm1.x",0.86]],"lower":0.1799,"upper":0.1801,"unit":"m","parts":2}. Constraints of one name from
   * several instances add their terms; with fewer than `parts` of them the host drops it. `kind`: survey, a
   * measurement with a tolerance, or range, a physical bound. */
  dragfree_status (*coefficient)(void *context, const char *json);
  dragfree_status (*constraint)(void *context, const char *json);
} dragfree_link_v1;

/* What `process` is given: one struct array per table that the instance reads, in the order in which `read` first
 * named the tables; child 0 is `time_ns` (format "l"), the others float64 (format "g"), never null, NaN for no value.
 * All uniform tables have the same rows; of an irregular table there is every row before `complete_until_ns` that was
 * not given before. The host owns all of it; valid during the call. */
typedef struct dragfree_inputs_v1 {
  int64_t complete_until_ns;
  uint32_t table_count;
  const struct ArrowSchema *schemas; /* field metadata: unit, frame, rate_hz */
  const struct ArrowArray *tables;
} dragfree_inputs_v1;

/* How far a source has come. */
typedef struct dragfree_progress_v1 {
  int64_t complete_until_ns; /* every row before this time has been delivered */
  int32_t done;              /* not 0: there is nothing more */
} dragfree_progress_v1;

/* An instance of a source, a stage or an effect. `self` and the pointers are set by `create`. A pointer that does not
 * belong to the kind may be NULL: `process` and `flush` for a source, `next` for the others. */
typedef struct dragfree_node_v1 {
  void *self;
  /* [created] Say what is read and written. */
  dragfree_status (*link)(void *self, const dragfree_link_v1 *link, dragfree_error_v1 *error);
  /* [linked] Take memory; no call will carry more than `max_rows` rows of a uniform table. */
  dragfree_status (*activate)(void *self, uint32_t max_rows, dragfree_error_v1 *error);
  /* [active] One batch. `outputs` holds one array per written table, all zero on entry; the plugin fills each with a
   * struct array that the host releases. An array left zero is a table without rows. An effect gives as many rows as
   * it gets. Results must not depend on where batches end. */
  dragfree_status (*process)(void *self, const dragfree_inputs_v1 *inputs, struct ArrowArray *outputs,
                             dragfree_error_v1 *error);
  /* [active] Sources: about `rows` more epochs. */
  dragfree_status (*next)(void *self, uint32_t rows, struct ArrowArray *outputs, dragfree_progress_v1 *progress,
                          dragfree_error_v1 *error);
  /* [active] There will be no more input: give what a lag held back. */
  dragfree_status (*flush)(void *self, struct ArrowArray *outputs, dragfree_error_v1 *error);
  /* [flushed; a source: active] The result as JSON; `earlier_json` is the array of the reports of the stages before
   * this one, each with `plugin`. May be NULL: nothing to report. Every key is optional; schema/report has all:
   * {"coefficients":[{"name":"my-force.tm1.y","solution":"mine","value":1.5e-10,"sigma":2e-11,"unit":"N A-1",
   *                   "frame":"ORF_1", "role":"recursive" (or "batch": the verdict compares them)}],
   *  "covariance":{"mine":{"names":["my-force.tm1.y"],"matrix":[[4e-22]]}},
   *  "verdict":"agree", "weak_directions":["…"], "chi2_per_dof":1.01, "nis":0.99, "commands":"telemetered",
   *  "epochs_used":863990, "epochs_rejected":10, "counts":{"spikes":3}, "notes":["a sentence for the operator"],
   *  "quality":{"free":"figures"}, "attachments":[{"suffix":"mine.json","text":"{}"}],
   *  "data_loss":false (true: exit code 3), "inconsistent":false (true: exit code 4)}. A source may give `time_scale`,
   * `mission` and `spacecraft` in `quality`. */
  dragfree_status (*report)(void *self, const char *earlier_json, const dragfree_writer_v1 *writer,
                            dragfree_error_v1 *error);
  /* [active] The whole state as bytes. May be NULL together with `load`: the instance has no state. */
  dragfree_status (*save)(void *self, const dragfree_writer_v1 *writer, dragfree_error_v1 *error);
  /* [active] Take a state back; refuse bytes that are not one with DRAGFREE_ERROR. */
  dragfree_status (*load)(void *self, const uint8_t *bytes, size_t length, dragfree_error_v1 *error);
  /* [any] Free everything. Called once. */
  void (*destroy)(void *self);
} dragfree_node_v1;

/* Makes instances of one kind. Valid as long as the library. Any thread. */
typedef struct dragfree_factory_v1 {
  uint32_t count;
  /* The manifest of plugin `index` < `count` as JSON, static: {"id":"gain","version":"1.0.0","licence":"MIT",
   * "description":"…","instances":["{test_mass}"],"needs":["commands"],"parameters":[{"name":"gain","type":"f64",
   * "unit":"1","default":1.0,"minimum":0.0,"maximum":10.0,"help":"…"}]}. A name in braces stands for each key of that
   * table of the mission file. Types: f64, i64, bool, text, f64_list, text_list; `choices` for text. `needs` of an
   * effect: columns that stages before it make on demand only, by the names that those stages give them (commands,
   * torque-response, dws-delay-response by hinf-dfacs). schema/manifest has all. */
  const char *(*manifest)(uint32_t index);
  /* Makes an instance: fills `node`, returns DRAGFREE_OK; otherwise leaves it untouched and says why. */
  dragfree_status (*create)(uint32_t index, const dragfree_host_v1 *host, const dragfree_config_v1 *config,
                            dragfree_node_v1 *node, dragfree_error_v1 *error);
} dragfree_factory_v1;

/* The one exported symbol. `abi_version` is first and stays first. */
typedef struct dragfree_entry_v1 {
  uint32_t abi_version; /* DRAGFREE_ABI_VERSION */
  uint32_t reserved;    /* 0 */
  /* The factory of an id, or NULL where the library has none. Static. Any thread. */
  const dragfree_factory_v1 *(*get_factory)(const char *id);
} dragfree_entry_v1;

#if defined(_WIN32)
#define DRAGFREE_EXPORT __declspec(dllexport)
#else
#define DRAGFREE_EXPORT __attribute__((visibility("default")))
#endif

/* A plugin defines:
 *   DRAGFREE_EXPORT const dragfree_entry_v1 dragfree_entry = { DRAGFREE_ABI_VERSION, 0, get_factory }; */

#ifdef __cplusplus
}
#endif
#endif
