/* Shared by all parts: the processor's instructions, sizes, and checked access to buffers. */
#pragma once
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

#if !defined(__x86_64__) || !defined(__GNUC__)
#error "written for x86-64 with GCC or Clang: without it Restock uses PyTorch"
#endif
#include <immintrin.h>
#include <stdlib.h>
#include <string.h>

#define INLINE static inline __attribute__((always_inline))
#define NARROW __attribute__((target("avx2,fma")))
#define WIDE __attribute__((target("avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")))

typedef Py_ssize_t Size;

static int has_narrow(void) {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}

static int has_wide(void) {
    return has_narrow() && __builtin_cpu_supports("avx512f") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512bw");
}

/* Get a contiguous float32 array of `ndim` dimensions; if `strided`, the rows may be apart. */
static int get_floats(PyObject *from, Py_buffer *view, int ndim, int writes, int strided,
                      const char *name) {
    int flags = PyBUF_STRIDES | PyBUF_FORMAT | (writes ? PyBUF_WRITABLE : 0);
    if (PyObject_GetBuffer(from, view, flags) < 0)
        return -1;
    int fits = view->ndim == ndim && view->itemsize == 4 && view->format &&
               strcmp(view->format, "f") == 0 && ((size_t)view->buf & 3) == 0;
    Size expected = 4;
    for (int d = ndim - 1; fits && d >= 0; d--) {
        int loose = strided && d == 0 && view->strides[0] % 4 == 0 && view->strides[0] >= expected;
        fits = view->shape[d] <= 1 || view->strides[d] == expected || loose;
        expected *= view->shape[d];
    }
    if (fits)
        return 0;
    PyBuffer_Release(view);
    PyErr_Format(PyExc_TypeError, "%s must be a %s float32 array of %d dimensions", name,
                 strided ? "row by row contiguous" : "contiguous", ndim);
    return -1;
}

/* Get a contiguous array of one dimension: `kind` is 'l' for int64 or 'd' for float64. */
static int get_vector(PyObject *from, Py_buffer *view, char kind, int writes, const char *name) {
    if (PyObject_GetBuffer(from, view, PyBUF_ND | PyBUF_FORMAT | (writes ? PyBUF_WRITABLE : 0)) < 0)
        return -1;
    char is = view->format && view->format[0] && !view->format[1] ? view->format[0] : 0;
    if (view->ndim == 1 && view->itemsize == 8 && ((size_t)view->buf & 7) == 0 &&
        (is == kind || (is == 'q' && kind == 'l')))
        return 0;
    PyBuffer_Release(view);
    PyErr_Format(PyExc_TypeError, "%s must be a contiguous %s vector", name,
                 kind == 'd' ? "float64" : "int64");
    return -1;
}

/* Get vectors of float64; those from number `written` on must be writable. Returns how many were
 * got: fewer than `count` if there was an error. */
static int get_vectors(PyObject **from, Py_buffer *view, int count, int written,
                       const char *const *names) {
    int held = 0;
    while (held < count && get_vector(from[held], &view[held], 'd', held >= written, names[held]) == 0)
        held++;
    return held;
}

/* Release the buffers, and return the answer. */
static PyObject *released(Py_buffer *view, int held, PyObject *answer) {
    while (held)
        PyBuffer_Release(&view[--held]);
    return answer;
}

static int wrong_shape(const char *name) {
    PyErr_Format(PyExc_ValueError, "%s has another shape than the others ask for", name);
    return -1;
}

/* The row stride in floats. A buffer of a single row may have any stride, so its width is returned. */
static Size row_of(const Py_buffer *view) {
    return view->shape[0] <= 1 ? view->shape[1] : view->strides[0] / 4;
}
