/* dragfree/rows.h - helpers for a plugin written in plain C: rows out as a struct array of times and float64
 * columns, as plugin.h wants it, and columns in. No part of the border: copy it, change it, or do without. */
#ifndef DRAGFREE_ROWS_H
#define DRAGFREE_ROWS_H

#include <dragfree/plugin.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static inline void release_child(struct ArrowArray *array) {
  free((void *)array->buffers[1]);
  free(array->buffers);
  array->release = NULL;
}

static inline void release_table(struct ArrowArray *array) {
  for (int64_t i = 0; i < array->n_children; i++) {
    if (array->children[i]->release) array->children[i]->release(array->children[i]);
    free(array->children[i]);
  }
  free(array->children);
  free(array->buffers);
  array->release = NULL;
}

/* A table of `rows` rows with `columns` float64 columns, its times copied; give the values with `column`. */
static inline int make_table(struct ArrowArray *out, const int64_t *time_ns, int64_t rows, int64_t columns) {
  memset(out, 0, sizeof *out);
  out->length = rows;
  out->n_buffers = 1;
  out->buffers = calloc(1, sizeof *out->buffers);
  out->n_children = columns + 1;
  out->children = calloc((size_t)columns + 1, sizeof *out->children);
  out->release = release_table;
  if (!out->buffers || !out->children) return 0;
  for (int64_t i = 0; i <= columns; i++) {
    struct ArrowArray *child = calloc(1, sizeof *child);
    out->children[i] = child;
    if (!child) return 0;
    child->length = rows;
    child->n_buffers = 2;
    child->buffers = calloc(2, sizeof *child->buffers);
    child->buffers[1] = malloc(rows ? (size_t)rows * 8 : 8);
    child->release = release_child;
    if (!child->buffers[1]) return 0;
  }
  memcpy((void *)out->children[0]->buffers[1], time_ns, (size_t)rows * 8);
  return 1;
}

static inline double *column(struct ArrowArray *table, int64_t index) {
  return (double *)table->children[index + 1]->buffers[1];
}

/* Column `index` of an input table; index -1 are the times. */
static inline const void *input(const struct ArrowArray *table, int64_t index) {
  const struct ArrowArray *child = table->children[index + 1];
  return (const char *)child->buffers[1] + 8 * child->offset;
}

static inline dragfree_status say(dragfree_error_v1 *error, dragfree_status status, const char *text) {
  if (error && error->capacity) {
    strncpy(error->text, text, error->capacity - 1);
    error->text[error->capacity - 1] = 0;
  }
  return status;
}

#endif
