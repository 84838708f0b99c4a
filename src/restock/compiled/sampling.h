/* Gather rows of large tables, and draw in proportion to priorities. */
#pragma once
#include "buffers.h"
#include <stdint.h>

#define AHEAD 16 /* rows that are prefetched ahead of the copied one */
#define LINE 64  /* bytes of a cache line */
#define CHUNK 16 /* priorities with a common sum; `CHUNK` of replay/sampling/rules.py */

PyDoc_STRVAR(gather_doc, "gather(rows, index, out)\n--\n\n"
                         "Copy rows `index` (B,) int64 of `rows` (n, W) to `out` (B, W), bit by bit.\n\n"
                         "IndexError: a row number is outside the table; `out` is unchanged then.");

/* Prefetch a row into the L2 cache, which can have more requests in flight than L1. */
INLINE void fetch(const float *row, Size width) {
    for (const char *at = (const char *)row, *end = (const char *)(row + width); at < end; at += LINE)
        __builtin_prefetch(at, 0, 2);
}

static PyObject *gather(PyObject *Py_UNUSED(module), PyObject *args) {
    PyObject *from, *numbers, *to, *answer = NULL;
    Py_buffer rows, index, out;
    if (!PyArg_ParseTuple(args, "OOO", &from, &numbers, &to))
        return NULL;
    if (get_floats(from, &rows, 2, 0, 0, "rows") < 0)
        return NULL;
    if (get_vector(numbers, &index, 'l', 0, "index") < 0)
        goto no_index;
    if (get_floats(to, &out, 2, 1, 0, "out") < 0)
        goto no_out;
    Size count = index.shape[0], width = rows.shape[1];
    const float *table = rows.buf;
    const int64_t *row = index.buf;
    if (out.shape[0] != count || out.shape[1] != width) {
        wrong_shape("out");
        goto done;
    }
    for (Size i = 0; i < count; i++)
        if (row[i] < 0 || row[i] >= rows.shape[0]) {
            PyErr_Format(PyExc_IndexError, "row %lld is not one of %zd", (long long)row[i],
                         rows.shape[0]);
            goto done;
        }
    Py_BEGIN_ALLOW_THREADS
    for (Size i = 0; i < AHEAD && i < count; i++)
        fetch(table + row[i] * width, width);
    for (Size i = 0; i < count; i++) {
        if (i + AHEAD < count)
            fetch(table + row[i + AHEAD] * width, width);
        memcpy((float *)out.buf + i * width, table + row[i] * width, sizeof(float) * (size_t)width);
    }
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    PyBuffer_Release(&out);
no_out:
    PyBuffer_Release(&index);
no_index:
    PyBuffer_Release(&rows);
    return answer;
}

PyDoc_STRVAR(find_places_doc,
             "find_places(priority, sums, ends, at, out)\n--\n\n"
             "Find the place of each `at` (n,) float64, ascending, in the cumulative sum of priorities.\n\n"
             "`priority` (m, 16) float32; `sums` (m,) float32 are the sums of its rows, `ends` (m,) float64\n"
             "the cumulative sum of these. Fills `out` (n,) int64 with the first place at which the\n"
             "cumulative sum is above `at`; within a row it is computed in float32, in order.");

/* The index of the first of `count` ends above `at`, from `begin` on; the last index if none is. */
INLINE Size first_above(const double *end, Size begin, Size count, double at) {
    Size step = 1, low = begin, high = begin;
    while (high < count - 1 && end[high] <= at) {
        low = high + 1;
        high = high + step < count - 1 ? high + step : count - 1;
        step *= 2;
    }
    while (low < high) {
        Size middle = low + (high - low) / 2;
        if (end[middle] <= at)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

static PyObject *find_places(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { PRIORITY, SUMS, ENDS, AT, OUT_, ALL };
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    int held = 0;
    if (!PyArg_ParseTuple(args, "OOOOO", &from[0], &from[1], &from[2], &from[3], &from[4]))
        return NULL;
    if (get_floats(from[PRIORITY], &view[PRIORITY], 2, 0, 0, "priority") < 0)
        goto done;
    held++;
    if (get_floats(from[SUMS], &view[SUMS], 1, 0, 0, "sums") < 0)
        goto done;
    held++;
    if (get_vector(from[ENDS], &view[ENDS], 'd', 0, "ends") < 0)
        goto done;
    held++;
    if (get_vector(from[AT], &view[AT], 'd', 0, "at") < 0)
        goto done;
    held++;
    if (get_vector(from[OUT_], &view[OUT_], 'l', 1, "out") < 0)
        goto done;
    held++;
    Size chunks = view[PRIORITY].shape[0], count = view[AT].shape[0], chunk = 0;
    if (chunks < 1 || view[PRIORITY].shape[1] != CHUNK || view[SUMS].shape[0] != chunks ||
        view[ENDS].shape[0] != chunks || view[OUT_].shape[0] != count) {
        wrong_shape("priority");
        goto done;
    }
    const float *sums = view[SUMS].buf;
    const double *ends = view[ENDS].buf, *at = view[AT].buf;
    int64_t *out = view[OUT_].buf;
    for (Size i = 0; i < count; i++) {
        chunk = first_above(ends, chunk, chunks, at[i]);
        const float *own = (const float *)view[PRIORITY].buf + chunk * CHUNK;
        float rest = (float)(at[i] - (ends[chunk] - (double)sums[chunk])), upto = 0.0f;
        int passed = 0;
        for (int member = 0; member < CHUNK - 1; member++) {
            upto += own[member];
            passed += upto <= rest;
        }
        out[i] = chunk * CHUNK + passed;
    }
    answer = Py_NewRef(Py_None);
done:
    return released(view, held, answer);
}
