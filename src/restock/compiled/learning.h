/* Adam and a moving average of the weights (the follower), in one pass. */
#pragma once
#include "buffers.h"

/* Rounds where PyTorch's fused Adam and `lerp_` round, including their fused multiply-adds, so that
 * builds for AVX2 and AVX-512 give the same bits. */

typedef struct {
    double first, second;              /* Adam's betas */
    float step_size, root, eps, rate; /* lr / (1 - beta1^t), sqrt(1 - beta2^t), eps, follower's rate */
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
             "Take a step of Adam on flat arrays; then move `follower` (or None) towards `values`.\n\n"
             "`settings` are beta1, beta2, lr / (1 - beta1^t), sqrt(1 - beta2^t), eps and the rate\n"
             "of the follower.");

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
