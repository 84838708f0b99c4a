/* Lidar ranges: the distance at which each beam first hits a shape, in a horizontal plane. */
#pragma once
#include "buffers.h"
#include <math.h>
#include <stdint.h>

#define SMALLEST 1e-15 /* a ray with a smaller component is parallel to that axis; MuJoCo's mjMINVAL */
#define MARGIN 1e-6    /* radians, for the rounding of bearings */
#define TURN 6.283185307179586

PyDoc_STRVAR(
    ranges_doc,
    "ranges(origin, heading, direction, bearing, order, floor, first, standing, moving, out)\n--\n\n"
    "Compute the distance from n lidars to the first hit of each of their B beams; inf if none.\n\n"
    "All arrays are flat. `origin` (n, 2), `heading` (n,), `direction` (n, B, 2) unit vectors. `bearing`\n"
    "(B,) ascending, relative to the heading, of the beams `order` (B,). `floor` (n,) is the number of\n"
    "each lidar's floor; boxes of floor f are rows `first`[f] to `first`[f + 1] of `standing` (G, 4):\n"
    "x, y, half sizes. `moving` (n, M, 6): x, y, cosine and sine of the heading, half sizes; if the\n"
    "second half size is 0, a circle whose radius is the first. Fills `out` (n, B).");

/* The distance at which a ray from (x, y) along (dx, dy) meets a box (half sizes a, b) centred at the
 * origin, or -1. From outside, only faces that the ray starts beyond count; from inside, the nearest
 * face ahead. */
INLINE double meet_box(double x, double y, double dx, double dy, double a, double b) {
    double best = -1;
    int inside = fabs(x) <= a && fabs(y) <= b;
    if (inside && ((fabs(x) == a && fabs(dx) > SMALLEST) || (fabs(y) == b && fabs(dy) > SMALLEST)))
        return 0; /* the ray starts on a face */
    if (fabs(dx) > SMALLEST && (inside || fabs(x) > a)) {
        double face = inside ? (dx > 0 ? a : -a) : (x > 0 ? a : -a);
        double at = (face - x) / dx;
        if (at >= 0 && fabs(y + at * dy) <= b)
            best = at;
    }
    if (fabs(dy) > SMALLEST && (inside || fabs(y) > b)) {
        double face = inside ? (dy > 0 ? b : -b) : (y > 0 ? b : -b);
        double at = (face - y) / dy;
        if (at >= 0 && fabs(x + at * dx) <= a && (best < 0 || at < best))
            best = at;
    }
    return best;
}

/* The same for a circle of radius r. */
INLINE double meet_circle(double x, double y, double dx, double dy, double r) {
    double a = dx * dx + dy * dy, b = dx * x + dy * y, c = x * x + y * y - r * r;
    double root = b * b - a * c;
    if (root < SMALLEST || a < SMALLEST)
        return -1;
    root = sqrt(root);
    double near = (-b - root) / a, far = (-b + root) / a;
    return near >= 0 ? near : far >= 0 ? far : -1;
}

/* The index of the first of `count` ascending values that is not below `at`. */
INLINE Size first_from(const double *value, Size count, double at) {
    Size low = 0;
    while (count > 0) {
        Size half = count / 2;
        if (value[low + half] < at) {
            low += half + 1;
            count -= half + 1;
        } else
            count = half;
    }
    return low;
}

typedef struct {
    const double *bearing, *direction; /* sorted; (B, 2) of one lidar */
    const int64_t *order;
    Size beams;
    double x, y, heading;
    double *out;
} Lidar;

/* Shorten the beams that hit a shape with centre (x, y); a and b are half sizes, as in `moving`. */
INLINE void shorten(const Lidar *lidar, double x, double y, double cosine, double sine, double a,
                    double b) {
    double from_x = lidar->x - x, from_y = lidar->y - y;
    double away = sqrt(from_x * from_x + from_y * from_y), radius = sqrt(a * a + b * b);
    double px = cosine * from_x + sine * from_y, py = cosine * from_y - sine * from_x;
    double half = radius < away ? asin(radius / away) + MARGIN : TURN;
    double middle = atan2(-from_y, -from_x) - lidar->heading;
    middle -= TURN * floor((middle - lidar->bearing[0]) / TURN);
    Size upto = 0;
    for (int turn = -1; turn <= 1 && upto < lidar->beams; turn++) {
        double from = middle + turn * TURN - half;
        Size beam = first_from(lidar->bearing, lidar->beams, from);
        for (beam = beam > upto ? beam : upto;
             beam < lidar->beams && lidar->bearing[beam] <= from + 2 * half; beam++) {
            Size own = lidar->order[beam];
            double dx = lidar->direction[2 * own], dy = lidar->direction[2 * own + 1];
            double lx = cosine * dx + sine * dy, ly = cosine * dy - sine * dx;
            double at = b > 0 ? meet_box(px, py, lx, ly, a, b) : meet_circle(px, py, lx, ly, a);
            if (at >= 0 && at < lidar->out[own])
                lidar->out[own] = at;
        }
        upto = beam > upto ? beam : upto;
    }
}

static PyObject *ranges(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { ORIGIN, HEADING, DIRECTION, BEARING, ORDER, FLOOR, FIRST, STANDING, MOVING, OUT_, ALL };
    static const char *names[ALL] = {"origin", "heading", "direction", "bearing", "order",
                                     "floor",  "first",   "standing",  "moving",  "out"};
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    int held = 0;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOO", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &from[5], &from[6], &from[7], &from[8], &from[9]))
        return NULL;
    for (; held < ALL; held++) {
        char kind = held == ORDER || held == FLOOR || held == FIRST ? 'l' : 'd';
        if (get_vector(from[held], &view[held], kind, held == OUT_, names[held]) < 0)
            goto done;
    }
    Size count = view[HEADING].shape[0], beams = view[BEARING].shape[0];
    Size floors = view[FIRST].shape[0] - 1, boxes = view[STANDING].shape[0] / 4;
    Size shapes = count ? view[MOVING].shape[0] / (6 * count) : 0;
    if (beams < 1 || floors < 1 || view[ORIGIN].shape[0] != 2 * count ||
        view[DIRECTION].shape[0] != 2 * count * beams || view[ORDER].shape[0] != beams ||
        view[FLOOR].shape[0] != count || view[STANDING].shape[0] != 4 * boxes ||
        view[MOVING].shape[0] != 6 * count * shapes || view[OUT_].shape[0] != count * beams) {
        wrong_shape("an argument");
        goto done;
    }
    const double *origin = view[ORIGIN].buf, *heading = view[HEADING].buf;
    const double *standing = view[STANDING].buf, *moving = view[MOVING].buf;
    const int64_t *order = view[ORDER].buf, *on = view[FLOOR].buf, *first = view[FIRST].buf;
    int fits = first[0] == 0 && first[floors] == boxes;
    for (Size f = 0; f < floors; f++)
        fits = fits && first[f] <= first[f + 1];
    for (Size b = 0; b < beams; b++)
        fits = fits && order[b] >= 0 && order[b] < beams;
    for (Size i = 0; i < count; i++)
        fits = fits && on[i] >= 0 && on[i] < floors;
    if (!fits) {
        PyErr_SetString(PyExc_IndexError, "order, floor or first names what is not there");
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS
    for (Size i = 0; i < count; i++) {
        Lidar lidar = {view[BEARING].buf,
                       (const double *)view[DIRECTION].buf + 2 * beams * i,
                       order,
                       beams,
                       origin[2 * i],
                       origin[2 * i + 1],
                       heading[i],
                       (double *)view[OUT_].buf + beams * i};
        for (Size b = 0; b < beams; b++)
            lidar.out[b] = INFINITY;
        for (Size g = first[on[i]]; g < first[on[i] + 1]; g++)
            shorten(&lidar, standing[4 * g], standing[4 * g + 1], 1, 0, standing[4 * g + 2],
                    standing[4 * g + 3]);
        for (Size m = 0; m < shapes; m++) {
            const double *shape = moving + 6 * (i * shapes + m);
            shorten(&lidar, shape[0], shape[1], shape[2], shape[3], shape[4], shape[5]);
        }
    }
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    return released(view, held, answer);
}
