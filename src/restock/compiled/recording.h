/* Record a batch: append its rows to columns, in one pass. */
#pragma once
#include "buffers.h"
#include <stdint.h>

PyDoc_STRVAR(
    keep_rows_doc,
    "keep_rows(values, logged, logged_to, logged_at, ring, slots, fresh_to, fresh_at, clocks)\n--\n\n"
    "Append a batch of B rows, of which the first L are logged, to the columns of both sources.\n\n"
    "`values`: td, q and weight (B,) float32 (weight may be None: all 1), and tail (B, 3) float32:\n"
    "action, reward, discount. `logged`: row and stratum (L,) int64. `ring`: the ring's columns (n,),\n"
    "condition and stratum int16, episode int64, episode_step int32, behaviour_policy int16, env_step\n"
    "and gradient_step int64; `slots` (B - L,) int64 are the fresh rows' places in the ring. Columns\n"
    "of `logged_to` begin with row and stratum int64. Those of `fresh_to` begin with condition and\n"
    "stratum int16, episode int64, episode_step int32, policy int16 and two ages int64: `clocks` minus\n"
    "the ring's env_step and gradient_step. Both end with td, q, weight float32, action int16, reward\n"
    "and discount float32. Writing begins at `logged_at` and `fresh_at`.\n\n"
    "IndexError: a slot is outside the ring, or a column has no room; nothing is written then.");

enum { OF_ROW, OF_STRATUM, OF_LOGS };
enum { OF_CONDITION, OF_FRESH_STRATUM, OF_EPISODE, OF_EPISODE_STEP, OF_POLICY, OF_ENV_STEP, OF_GRADIENT_STEP, OF_RING };
enum { VALUE_TD, VALUE_Q, VALUE_WEIGHT, VALUE_ACTION, VALUE_REWARD, VALUE_DISCOUNT, VALUES };
#define MAX_VIEWS 40

typedef struct {
    Py_buffer view[MAX_VIEWS];
    int held;
} Views;

/* Get a contiguous vector of int16 'h', int32 'i', int64 'l' or float32 'f', of at least `least` values. */
static void *get_column(Views *views, PyObject *from, char kind, Size least, int writes) {
    Py_buffer *view = &views->view[views->held];
    if (PyObject_GetBuffer(from, view, PyBUF_ND | PyBUF_FORMAT | (writes ? PyBUF_WRITABLE : 0)) < 0)
        return NULL;
    views->held++;
    char is = view->format && view->format[0] && !view->format[1] ? view->format[0] : 0;
    if (is == 'q')
        is = 'l';
    if (view->ndim != 1 || is != kind || (size_t)view->buf % (size_t)view->itemsize) {
        PyErr_Format(PyExc_TypeError, "a column must be a contiguous vector of '%c', not '%s'", kind,
                     view->format ? view->format : "");
        return NULL;
    }
    if (view->shape[0] < least) {
        PyErr_Format(PyExc_IndexError, "a column has room for %zd values, not %zd", view->shape[0],
                     least);
        return NULL;
    }
    return view->buf;
}

/* Get all columns of a tuple; `kinds` has a letter for each. */
static int get_columns(Views *views, PyObject *from, const char *kinds, Size least, int writes,
                       void **columns) {
    Size count = (Size)strlen(kinds);
    if (!PyTuple_Check(from) || PyTuple_Size(from) != count) {
        PyErr_Format(PyExc_TypeError, "columns must be a tuple of %zd", count);
        return -1;
    }
    for (Size i = 0; i < count; i++)
        if (!(columns[i] = get_column(views, PyTuple_GetItem(from, i), kinds[i], least, writes)))
            return -1;
    return 0;
}

INLINE void keep_values(void **to, Size at, float *const *value, const float *tail, Size stride,
                        Size begin, Size end) {
    for (int name = VALUE_TD; name <= VALUE_WEIGHT; name++) {
        float *column = (float *)to[name] + at;
        for (Size i = begin; i < end; i++)
            column[i - begin] = value[name] ? value[name][i] : 1.0f;
    }
    int16_t *action = (int16_t *)to[VALUE_ACTION] + at;
    float *reward = (float *)to[VALUE_REWARD] + at, *discount = (float *)to[VALUE_DISCOUNT] + at;
    for (Size i = begin; i < end; i++) {
        action[i - begin] = (int16_t)tail[i * stride];
        reward[i - begin] = tail[i * stride + 1];
        discount[i - begin] = tail[i * stride + 2];
    }
}

static PyObject *keep_rows(PyObject *Py_UNUSED(module), PyObject *args) {
    PyObject *value_from[3], *tail_from, *logged_from, *logged_into, *ring_from, *slots_from;
    PyObject *fresh_into, *answer = NULL;
    Size logged_at, fresh_at;
    long long env_steps, step;
    void *logged_of[OF_LOGS], *logged_to[OF_LOGS + VALUES], *ring[OF_RING],
        *fresh_to[OF_RING + VALUES];
    float *value[3] = {NULL, NULL, NULL};
    Views views = {.held = 0};
    Py_buffer tail_view;
    if (!PyArg_ParseTuple(args, "(OOOO)OOnOOOn(LL)", &value_from[VALUE_TD], &value_from[VALUE_Q],
                          &value_from[VALUE_WEIGHT], &tail_from, &logged_from, &logged_into, &logged_at,
                          &ring_from, &slots_from, &fresh_into, &fresh_at, &env_steps, &step))
        return NULL;
    if (get_floats(tail_from, &tail_view, 2, 0, 1, "tail") < 0)
        return NULL;
    Size batch = tail_view.shape[0], stride = row_of(&tail_view);
    if (tail_view.shape[1] != 3 || logged_at < 0 || fresh_at < 0) {
        wrong_shape("tail");
        goto done;
    }
    for (int name = VALUE_TD; name <= VALUE_WEIGHT; name++)
        if (name != VALUE_WEIGHT || value_from[name] != Py_None)
            if (!(value[name] = get_column(&views, value_from[name], 'f', batch, 0)))
                goto done;
    const int64_t *slot = get_column(&views, slots_from, 'l', 0, 0);
    if (!slot)
        goto done;
    Size fresh = views.view[views.held - 1].shape[0], logged = batch - fresh;
    if (logged < 0) {
        wrong_shape("slots");
        goto done;
    }
    if (get_columns(&views, logged_from, "ll", logged, 0, logged_of) < 0 ||
        get_columns(&views, logged_into, "llfffhff", logged_at + logged, 1, logged_to) < 0 ||
        get_columns(&views, ring_from, "hhlihll", 0, 0, ring) < 0)
        goto done;
    Size rows = views.view[views.held - OF_RING].shape[0];
    for (int name = 1; name < OF_RING; name++)
        if (views.view[views.held - name].shape[0] < rows)
            rows = views.view[views.held - name].shape[0];
    if (get_columns(&views, fresh_into, "hhlihllfffhff", fresh_at + fresh, 1, fresh_to) < 0)
        goto done;
    for (Size i = 0; i < fresh; i++)
        if (slot[i] < 0 || slot[i] >= rows) {
            PyErr_Format(PyExc_IndexError, "slot %lld is not one of %zd", (long long)slot[i], rows);
            goto done;
        }
    for (int name = 0; name < OF_LOGS; name++)
        memcpy((int64_t *)logged_to[name] + logged_at, logged_of[name],
               sizeof(int64_t) * (size_t)logged);
    const float *tail = tail_view.buf;
    keep_values(logged_to + OF_LOGS, logged_at, value, tail, stride, 0, logged);
    int16_t *condition = (int16_t *)fresh_to[OF_CONDITION] + fresh_at;
    int16_t *stratum = (int16_t *)fresh_to[OF_FRESH_STRATUM] + fresh_at;
    int64_t *episode = (int64_t *)fresh_to[OF_EPISODE] + fresh_at;
    int32_t *episode_step = (int32_t *)fresh_to[OF_EPISODE_STEP] + fresh_at;
    int16_t *policy = (int16_t *)fresh_to[OF_POLICY] + fresh_at;
    int64_t *age = (int64_t *)fresh_to[OF_ENV_STEP] + fresh_at;
    int64_t *age_updates = (int64_t *)fresh_to[OF_GRADIENT_STEP] + fresh_at;
    for (Size i = 0; i < fresh; i++) { /* loads are independent, so several are in flight at once */
        int64_t from = slot[i];
        condition[i] = ((const int16_t *)ring[OF_CONDITION])[from];
        stratum[i] = ((const int16_t *)ring[OF_FRESH_STRATUM])[from];
        episode[i] = ((const int64_t *)ring[OF_EPISODE])[from];
        episode_step[i] = ((const int32_t *)ring[OF_EPISODE_STEP])[from];
        policy[i] = ((const int16_t *)ring[OF_POLICY])[from];
        age[i] = env_steps - ((const int64_t *)ring[OF_ENV_STEP])[from];
        age_updates[i] = step - ((const int64_t *)ring[OF_GRADIENT_STEP])[from];
    }
    keep_values(fresh_to + OF_RING, fresh_at, value, tail, stride, logged, batch);
    answer = Py_NewRef(Py_None);
done:
    while (views.held)
        PyBuffer_Release(&views.view[--views.held]);
    PyBuffer_Release(&tail_view);
    return answer;
}
