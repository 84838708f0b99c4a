/* `restock._native`: the update of a plain Q network, draws and records of its batches, the twin's
 * lidar, what robots observe of their plans and of people nearby, and distances to boxes.
 *
 * It computes the same as PyTorch in `train/dqn/network.py`, as NumPy in `train/feed/batches.py`,
 * `train/feed/sampled_rows.py`, `replay/sampling/rules.py`, `ingest/task/surroundings.py` and
 * `train/twin/floors/state_lattice.py`, and as MuJoCo's rays in `train/twin/physics/scenery.py`, in
 * fewer calls and fewer passes over memory. `restock/native.py` imports it.
 *
 * It is compiled with -ffp-contract=off and without fast-math: sums have one order, so every processor
 * gives the same bits. It needs x86-64 with AVX2 and FMA, and GCC or Clang. Elsewhere it does not
 * compile, or importing it fails, and the Python code above is used. Stable ABI: one build serves
 * Python 3.11 and later.
 */
#include "buffers.h"
#include "learning.h"
#include "network.h"
#include "ranging.h"
#include "recording.h"
#include "sampling.h"
#include "surroundings.h"

static PyMethodDef module_methods[] = {
    {"adam", adam, METH_VARARGS, adam_doc},
    {"gather", gather, METH_VARARGS, gather_doc},
    {"find_places", find_places, METH_VARARGS, find_places_doc},
    {"ranges", ranges, METH_VARARGS, ranges_doc},
    {"keep_rows", keep_rows, METH_VARARGS, keep_rows_doc},
    {"view_plans", view_plans, METH_VARARGS, view_plans_doc},
    {"find_returns", find_returns, METH_VARARGS, find_returns_doc},
    {"find_came", find_came, METH_VARARGS, find_came_doc},
    {"near_boxes", near_boxes, METH_VARARGS, near_boxes_doc},
    {NULL, NULL, 0, NULL},
};

static int module_exec(PyObject *module) {
    if (!has_narrow()) {
        PyErr_SetString(PyExc_ImportError, "this processor has no AVX2 with FMA");
        return -1;
    }
    PyObject *type = PyType_FromModuleAndSpec(module, &network_spec, NULL);
    if (!type)
        return -1;
    int failed = PyModule_AddObjectRef(module, "Network", type) < 0 ||
                 PyModule_AddStringConstant(
                     module, "INSTRUCTIONS",
                     has_wide() ? "AVX-512" : "AVX2") < 0;
    Py_DECREF(type);
    return failed ? -1 : 0;
}

static PyModuleDef_Slot module_slots[] = {{Py_mod_exec, module_exec}, {0, NULL}};

static struct PyModuleDef module_definition = {
    PyModuleDef_HEAD_INIT, "_native", "A plain Q network's update and its batches, compiled.", 0,
    module_methods,        module_slots, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__native(void) { return PyModuleDef_Init(&module_definition); }
