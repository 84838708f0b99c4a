/* `Network`: a plain Q network with flat parameters; forward and backward pass are one call each. */
#pragma once
#include "layers.h"
#include "products.h"

#define MAX_LAYERS 64
#define MAX_GIVEN ((Size)1 << 32) /* rows at once, so that sizes in bytes do not overflow */

typedef struct {
    PyObject_HEAD
    Py_buffer values, gradient; /* flat, in the layout of `FlatParameters` */
    int has_values, has_gradient, busy, norm;
    const Tiles *tiles;
    const Rows *by_row;
    int hidden;                         /* number of hidden layers, without the head */
    Size width[MAX_LAYERS + 2];        /* observation, hidden layers, actions */
    Size weight[MAX_LAYERS + 1];       /* offset of each layer's weight in `values` */
    Size bias[MAX_LAYERS + 1], end;    /* offset of its bias, which gain and shift follow */
    Hidden layer[MAX_LAYERS];
    Size room, given; /* rows that `memory` has room for; rows of the last first input, or -1 */
    float *memory, *input, *down, *spare, *panel;
} Network;

static Size aligned(Size count) { return (count + LANES - 1) / LANES * LANES; }

static void lay_out(Network *self) {
    const float *values = self->values.buf;
    float *gradient = self->has_gradient ? self->gradient.buf : NULL;
    for (int l = 0; l < self->hidden; l++) {
        Hidden *layer = &self->layer[l];
        Size width = self->width[l + 1], gain = self->bias[l] + aligned(width);
        layer->width = width;
        layer->bias = values + self->bias[l];
        layer->gain = self->norm ? values + gain : NULL;
        layer->shift = self->norm ? values + gain + aligned(width) : NULL;
        layer->d_bias = gradient ? gradient + self->bias[l] : NULL;
        layer->d_gain = gradient && self->norm ? gradient + gain : NULL;
        layer->d_shift = gradient && self->norm ? gradient + gain + aligned(width) : NULL;
    }
}

/* Allocate memory for `rows` rows, if there is not enough. */
static int make_room(Network *self, Size rows) {
    if (self->memory && rows <= self->room)
        return 0;
    if (rows > MAX_GIVEN) {
        PyErr_Format(PyExc_ValueError, "%zd rows at once", rows);
        return -1;
    }
    rows = rows ? rows : 1;
    Size floats = 0, widest = 0;
    for (int l = 0; l <= self->hidden; l++) {
        Size below = self->width[l], above = self->width[l + 1];
        if (below > widest)
            widest = below;
        if (above > widest)
            widest = above;
        if (l < self->hidden)
            floats += (1 + self->norm) * aligned(rows * above) + aligned(rows);
    }
    Size deepest = rows > widest ? rows : widest; /* largest depth of a panel */
    floats += aligned(rows * self->width[0]) + 2 * aligned(rows * widest) + deepest * PANEL + LANES;
    float *memory = malloc(sizeof(float) * (size_t)floats);
    if (!memory) {
        PyErr_NoMemory();
        return -1;
    }
    free(self->memory);
    self->memory = memory;
    float *at = (float *)(((size_t)memory + 63) & ~(size_t)63);
    self->input = at, at += aligned(rows * self->width[0]);
    for (int l = 0; l < self->hidden; l++) {
        Hidden *layer = &self->layer[l];
        layer->after = at, at += aligned(rows * layer->width);
        layer->normed = self->norm ? at : NULL, at += self->norm * aligned(rows * layer->width);
        layer->inverse = at, at += aligned(rows);
    }
    self->down = at, at += aligned(rows * widest);
    self->spare = at, at += aligned(rows * widest);
    self->panel = at;
    self->room = rows;
    self->given = -1;
    return 0;
}

static void run_forward(Network *self, Size rows, float *out) {
    const float *values = self->values.buf, *x = self->input;
    for (int l = 0; l <= self->hidden; l++) {
        Size below = self->width[l], above = self->width[l + 1];
        int head = l == self->hidden;
        float *z = head ? out : self->norm ? self->layer[l].normed : self->layer[l].after;
        multiply(self->tiles, x, below, 1, values + self->weight[l], 1, below, z, rows, above, below,
                 self->panel);
        if (head) {
            for (Size row = 0; row < rows; row++)
                for (Size i = 0; i < above; i++)
                    out[row * above + i] += values[self->bias[l] + i];
        } else {
            self->by_row->activate(&self->layer[l], rows);
            x = self->layer[l].after;
        }
    }
}

static void run_backward(Network *self, const float *gradient, Size rows) {
    const float *values = self->values.buf;
    float *into = self->gradient.buf, *panel = self->panel;
    for (int l = self->hidden; l >= 0; l--) {
        Size below = self->width[l], above = self->width[l + 1];
        const float *x = l ? self->layer[l - 1].after : self->input, *g = gradient;
        if (l == self->hidden) {
            float *sums = into + self->bias[l];
            memset(sums, 0, sizeof(float) * (size_t)above);
            for (Size row = 0; row < rows; row++)
                for (Size i = 0; i < above; i++)
                    sums[i] += g[row * above + i];
        } else {
            self->by_row->back(&self->layer[l], self->down, rows);
            g = self->down;
        }
        multiply(self->tiles, g, 1, above, x, below, 1, into + self->weight[l], above, below, rows,
                 panel);
        if (l) {
            multiply(self->tiles, g, above, 1, values + self->weight[l], below, 1, self->spare, rows,
                     below, above, panel);
            float *made = self->spare;
            self->spare = self->down, self->down = made;
        }
    }
}

static int claim(Network *self) {
    if (!self->has_values) {
        PyErr_SetString(PyExc_RuntimeError, "the network was not initialised");
        return -1;
    }
    if (self->busy) {
        PyErr_SetString(PyExc_RuntimeError, "the network is at work in another thread");
        return -1;
    }
    self->busy = 1;
    return 0;
}

PyDoc_STRVAR(forward_doc,
             "forward(inputs, out)\n--\n\n"
             "Write action values (n B, A) of n inputs (B, D) to `out`; keep the first input for `backward`.");

static PyObject *network_forward(PyObject *object, PyObject *args) {
    Network *self = (Network *)object;
    PyObject *inputs, *target, *answer = NULL;
    if (!PyArg_ParseTuple(args, "O!O", &PyTuple_Type, &inputs, &target) || claim(self) < 0)
        return NULL;
    Py_buffer out, view;
    Size count = PyTuple_Size(inputs), each = 0, size = self->width[0];
    Size actions = self->width[self->hidden + 1];
    if (get_floats(target, &out, 2, 1, 0, "out") < 0)
        goto released;
    if (count < 1 || out.shape[0] % count || out.shape[1] != actions) {
        wrong_shape("out");
        goto done;
    }
    each = out.shape[0] / count;
    if (make_room(self, out.shape[0]) < 0)
        goto done;
    self->given = -1;
    for (Size i = 0; i < count; i++) {
        if (get_floats(PyTuple_GetItem(inputs, i), &view, 2, 0, 1, "an input") < 0)
            goto done;
        int fits = view.shape[0] == each && view.shape[1] == size;
        for (Size row = 0; fits && row < each; row++)
            memcpy(self->input + (i * each + row) * size,
                   (const float *)view.buf + row * row_of(&view), sizeof(float) * (size_t)size);
        PyBuffer_Release(&view);
        if (!fits) {
            wrong_shape("an input");
            goto done;
        }
    }
    Py_BEGIN_ALLOW_THREADS
    run_forward(self, out.shape[0], out.buf);
    Py_END_ALLOW_THREADS
    self->given = each;
    answer = Py_NewRef(Py_None);
done:
    PyBuffer_Release(&out);
released:
    self->busy = 0;
    return answer;
}

PyDoc_STRVAR(backward_doc, "backward(gradient)\n--\n\n"
                           "Compute the gradients of all parameters from the gradient (B, A) of the first "
                           "input's action values.");

static PyObject *network_backward(PyObject *object, PyObject *from) {
    Network *self = (Network *)object;
    PyObject *answer = NULL;
    Py_buffer view;
    if (claim(self) < 0)
        return NULL;
    if (!self->has_gradient) {
        PyErr_SetString(PyExc_RuntimeError,
                        "this network does not learn: its parameters have no gradients");
    } else if (get_floats(from, &view, 2, 0, 0, "gradient") == 0) {
        if (self->given < 0 || view.shape[0] != self->given ||
            view.shape[1] != self->width[self->hidden + 1]) {
            wrong_shape("gradient");
        } else {
            Py_BEGIN_ALLOW_THREADS
            run_backward(self, view.buf, self->given);
            Py_END_ALLOW_THREADS
            answer = Py_NewRef(Py_None);
        }
        PyBuffer_Release(&view);
    }
    self->busy = 0;
    return answer;
}

static int read_widths(Network *self, PyObject *widths) {
    Size count = PyTuple_Size(widths), at = 0;
    if (count < 3 || count > MAX_LAYERS + 2) {
        PyErr_Format(PyExc_ValueError, "between 3 and %d widths, got %zd", MAX_LAYERS + 2, count);
        return -1;
    }
    self->hidden = (int)count - 2;
    for (Size i = 0; i < count; i++) {
        self->width[i] = PyLong_AsSsize_t(PyTuple_GetItem(widths, i));
        if (self->width[i] == -1 && PyErr_Occurred())
            return -1;
        if (self->width[i] < 1 || self->width[i] > 1 << 20) {
            PyErr_Format(PyExc_ValueError, "a width of %zd", self->width[i]);
            return -1;
        }
    }
    for (int l = 0; l <= self->hidden; l++) {
        Size above = self->width[l + 1];
        self->weight[l] = at, at += aligned(self->width[l] * above);
        self->bias[l] = at, at += aligned(above) * (self->norm && l < self->hidden ? 3 : 1);
    }
    self->end = at;
    return 0;
}

static int network_init(PyObject *object, PyObject *args, PyObject *named) {
    Network *self = (Network *)object;
    static char *names[] = {"widths", "eps", "values", "gradient", "wide", NULL};
    PyObject *widths, *values, *gradient;
    double eps;
    int wide = 1;
    if (self->has_values) {
        PyErr_SetString(PyExc_RuntimeError, "the network was initialised before");
        return -1;
    }
    if (!PyArg_ParseTupleAndKeywords(args, named, "O!dOO|p", names, &PyTuple_Type, &widths, &eps,
                                     &values, &gradient, &wide))
        return -1;
    self->norm = eps >= 0;
    wide = wide && has_wide();
    self->tiles = wide ? &WIDE_TILES : &NARROW_TILES;
    self->by_row = wide ? &WIDE_ROWS : &NARROW_ROWS;
    if (read_widths(self, widths) < 0 || get_floats(values, &self->values, 1, 0, 0, "values") < 0)
        return -1;
    if (self->values.shape[0] != self->end) {
        PyBuffer_Release(&self->values);
        return wrong_shape("values");
    }
    if (gradient != Py_None) {
        if (get_floats(gradient, &self->gradient, 1, 1, 0, "gradient") < 0) {
            PyBuffer_Release(&self->values);
            return -1;
        }
        self->has_gradient = 1;
        if (self->gradient.shape[0] != self->end) {
            PyBuffer_Release(&self->values);
            PyBuffer_Release(&self->gradient);
            self->has_gradient = 0;
            return wrong_shape("gradient");
        }
    }
    self->has_values = 1;
    self->given = -1;
    for (int l = 0; l < self->hidden; l++)
        self->layer[l].eps = (float)eps;
    lay_out(self);
    return 0;
}

static void network_dealloc(PyObject *object) {
    Network *self = (Network *)object;
    PyTypeObject *type = Py_TYPE(object);
    if (self->has_values)
        PyBuffer_Release(&self->values);
    if (self->has_gradient)
        PyBuffer_Release(&self->gradient);
    free(self->memory);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(object);
    Py_DECREF(type);
}

PyDoc_STRVAR(network_doc,
             "Network(widths, eps, values, gradient, wide=True)\n--\n\n"
             "A network of layers `widths` (D, H, ..., A) with flat parameters.\n\n"
             "`eps` is LayerNorm's, or below 0 for no LayerNorm; `gradient` is None for a network that\n"
             "does not learn; `wide` allows AVX-512.");

static PyMethodDef network_methods[] = {
    {"forward", network_forward, METH_VARARGS, forward_doc},
    {"backward", network_backward, METH_O, backward_doc},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot network_slots[] = {
    {Py_tp_doc, (void *)network_doc},       {Py_tp_init, network_init},
    {Py_tp_new, PyType_GenericNew},         {Py_tp_dealloc, network_dealloc},
    {Py_tp_methods, network_methods},       {0, NULL},
};

static PyType_Spec network_spec = {"restock._native.Network", sizeof(Network), 0,
                                   Py_TPFLAGS_DEFAULT, network_slots};
