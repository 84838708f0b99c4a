/* The loss of DQN with its gradient, and Adam with the average of weights, each in one pass. */
#pragma once
#include "buffers.h"

/* The first of the largest of `count` values, a NaN before any other; as `Tensor.argmax`. */
static Size best_of(const float *value, const unsigned char *allowed, Size count) {
    Size best = 0;
    float most = -__builtin_inff();
    for (Size i = 0; i < count; i++) {
        if (allowed && !allowed[i])
            continue;
        if (value[i] != value[i])
            return i;
        if (value[i] > most)
            best = i, most = value[i];
    }
    return best;
}

PyDoc_STRVAR(td_loss_doc,
             "td_loss(q, next_target_q, chooses, plausible, tail, weight, delta, gradient, out)\n"
             "--\n\n"
             "`td_target`, `dqn_loss` and `dqn_gradient` of `loss.py` at once.\n\n"
             "`chooses` (B, A) selects the next action; `plausible` (B, A) bool or None;\n"
             "`tail` (B, 3) is action, reward, discount; `weight` (B,) or None. Fills `gradient`\n"
             "(B, A) and `out` (2 B + 1,): td, Q(s, a), the loss.");

enum { Q, NEXT, CHOOSES, TAIL, GRADIENT, OUT, WEIGHT, VIEWS };

static int fill_loss(const Py_buffer *view, const unsigned char *plausible, const float *weight,
                     float delta) {
    Size rows = view[Q].shape[0], actions = view[Q].shape[1], stride = row_of(&view[TAIL]);
    const float *q = view[Q].buf, *next = view[NEXT].buf, *chooses = view[CHOOSES].buf;
    float *gradient = view[GRADIENT].buf, *td = view[OUT].buf, *taken = td + rows;
    double total = 0;
    memset(gradient, 0, sizeof(float) * (size_t)(rows * actions));
    for (Size row = 0; row < rows; row++) {
        const float *tail = (const float *)view[TAIL].buf + row * stride;
        if (!(tail[0] > -1.0f && tail[0] < (float)actions)) {
            PyErr_Format(PyExc_IndexError, "row %zd has an action that is not one of %zd", row,
                         actions);
            return -1;
        }
        Size at = row * actions, action = (Size)tail[0];
        Size best = best_of(chooses + at, plausible ? plausible + at : NULL, actions);
        float by = weight ? weight[row] : 1.0f, error, size, slope;
        float bootstrap = tail[2] * next[at + best];
        taken[row] = q[at + action];
        td[row] = error = taken[row] - (tail[1] + bootstrap);
        size = error < 0 ? -error : error;
        total += (double)((size <= delta ? 0.5f * error * error : delta * (size - 0.5f * delta)) * by);
        slope = error < -delta ? -delta : error > delta ? delta : error;
        gradient[at + action] = slope * by / (float)rows;
    }
    td[2 * rows] = (float)(total / (double)rows);
    return 0;
}

static PyObject *td_loss(PyObject *Py_UNUSED(module), PyObject *args) {
    static const char *names[VIEWS] = {"q",    "next_target_q", "chooses", "tail",
                                       "gradient", "out",           "weight"};
    PyObject *from[VIEWS], *allowed, *answer = NULL;
    Py_buffer view[VIEWS], mask;
    double delta;
    int held = 0, masked = 0;
    if (!PyArg_ParseTuple(args, "OOOOOOdOO", &from[Q], &from[NEXT], &from[CHOOSES], &allowed,
                          &from[TAIL], &from[WEIGHT], &delta, &from[GRADIENT], &from[OUT]))
        return NULL;
    int weighted = from[WEIGHT] != Py_None;
    for (; held < VIEWS - !weighted; held++)
        if (get_floats(from[held], &view[held], held == OUT || held == WEIGHT ? 1 : 2,
                       held == OUT || held == GRADIENT, held == TAIL, names[held]) < 0)
            goto done;
    Size rows = view[Q].shape[0], actions = view[Q].shape[1];
    for (int i = 0; i < held; i++) {
        Size width = i == TAIL ? 3 : actions, length = i == OUT ? 2 * rows + 1 : rows;
        if (view[i].shape[0] != length || (view[i].ndim == 2 && view[i].shape[1] != width)) {
            wrong_shape(names[i]);
            goto done;
        }
    }
    if (rows < 1 || actions < 1) {
        wrong_shape("q");
        goto done;
    }
    if (allowed != Py_None) {
        if (PyObject_GetBuffer(allowed, &mask, PyBUF_ND | PyBUF_FORMAT) < 0)
            goto done;
        masked = 1;
        if (mask.ndim != 2 || mask.itemsize != 1 || mask.shape[0] != rows ||
            mask.shape[1] != actions) {
            wrong_shape("plausible");
            goto done;
        }
    }
    if (fill_loss(view, masked ? mask.buf : NULL, weighted ? view[WEIGHT].buf : NULL,
                  (float)delta) == 0)
        answer = Py_NewRef(Py_None);
done:
    if (masked)
        PyBuffer_Release(&mask);
    return released(view, held, answer);
}

/* Rounded where PyTorch's fused Adam and `lerp_` round, fused multiply-adds included: built for AVX2
 * or AVX-512 they give the same bits. */

typedef struct {
    double first, second;              /* Adam's betas */
    float step_size, root, eps, rate; /* lr / (1 - beta1^t), sqrt(1 - beta2^t); of the follower */
} Moves;

INLINE void move(float *restrict value, const float *restrict gradient, float *restrict mean,
                 float *restrict squares, float *restrict follower, Size count, Moves by) {
    float first = (float)(1 - by.first), kept = (float)by.second, second = (float)(1 - by.second);
    for (Size i = 0; i < count; i++) {
        float g = gradient[i];
        float m = __builtin_fmaf(first, g - mean[i], mean[i]);
        float s = __builtin_fmaf(second * g, g, squares[i] * kept);
        mean[i] = m;
        squares[i] = s;
        value[i] -= by.step_size * m / (__builtin_sqrtf(s) / by.root + by.eps);
        if (follower)
            follower[i] = __builtin_fmaf(by.rate, value[i] - follower[i], follower[i]);
    }
}

typedef void Move(float *, const float *, float *, float *, float *, Size, Moves);

#define MOVE(NAME, TARGET)                                                                        \
    TARGET static void NAME(float *value, const float *gradient, float *mean, float *squares,     \
                            float *follower, Size count, Moves by) {                              \
        if (follower)                                                                             \
            move(value, gradient, mean, squares, follower, count, by);                            \
        else                                                                                      \
            move(value, gradient, mean, squares, NULL, count, by);                                \
    }

MOVE(wide_move, WIDE)
MOVE(narrow_move, NARROW)

PyDoc_STRVAR(adam_doc,
             "adam(values, gradient, exp_avg, exp_avg_sq, follower, settings)\n--\n\n"
             "Adam's step on flat arrays; then `follower` (or None) goes towards `values`.\n\n"
             "`settings` are beta1, beta2, lr / (1 - beta1^t), sqrt(1 - beta2^t), eps and the rate\n"
             "at which `follower` goes there.");

static PyObject *adam(PyObject *Py_UNUSED(module), PyObject *args) {
    static const char *names[] = {"values", "gradient", "exp_avg", "exp_avg_sq", "follower"};
    PyObject *from[5], *answer = NULL;
    Py_buffer view[5];
    Moves by;
    int held = 0;
    if (!PyArg_ParseTuple(args, "OOOOO(ddffff)", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &by.first, &by.second, &by.step_size, &by.root, &by.eps, &by.rate))
        return NULL;
    int wanted = from[4] == Py_None ? 4 : 5;
    for (; held < wanted; held++)
        if (get_floats(from[held], &view[held], 1, held != 1, 0, names[held]) < 0)
            goto done;
    for (int i = 1; i < wanted; i++)
        if (view[i].shape[0] != view[0].shape[0]) {
            wrong_shape(names[i]);
            goto done;
        }
    Move *moves = has_wide() ? wide_move : narrow_move;
    Py_BEGIN_ALLOW_THREADS
    moves(view[0].buf, view[1].buf, view[2].buf, view[3].buf, wanted == 5 ? view[4].buf : NULL,
          view[0].shape[0], by);
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    return released(view, held, answer);
}
