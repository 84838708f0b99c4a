/* Where robots are on their plans, obstacles on the plans, and who came nearer. */
#pragma once
#include "buffers.h"
#include <math.h>

#define ROUNDING 1e-13 /* relative, of squared distances; `surroundings.ROUNDING` */

PyDoc_STRVAR(
    view_plans_doc,
    "view_plans(plans, x, y, cosine, sine, ahead, look_ahead, remaining, offset)\n--\n\n"
    "Compute `restock.ingest.task.surroundings.view_route` for n robots, bit for bit.\n\n"
    "All arrays are flat float64. `plans` (n, P, 2), P at least 2; poses `x`, `y`, `cosine` and `sine`\n"
    "of the heading (n,); `ahead` (L,) metres along the plan. Fills `look_ahead` (n, L, 2) in the body\n"
    "frame, `remaining` and `offset` (n,).");

PyDoc_STRVAR(
    find_returns_doc,
    "find_returns(x, y, clearance, plan, way, gap, limits)\n--\n\n"
    "Compute `restock.ingest.task.surroundings.returns_on_plan` for n robots, bit for bit.\n\n"
    "All arrays are flat float64. Lidar returns `x`, `y` with their `clearance` (n, K); points of the\n"
    "plan `plan` (n, L, 2). Fills `way` and `gap` (n,). `limits`: the lidar's range, its square, the\n"
    "squared distance from the plan that counts as on it, and how far along the plan to look for a gap.");

PyDoc_STRVAR(
    find_came_doc,
    "find_came(clearance, before, motions, walked, cosine, sine, reach, ends, came, limits)\n--\n\n"
    "Compute `restock.ingest.task.surroundings.came_nearer` for n robots, bit for bit.\n\n"
    "All arrays are flat float64. `clearance` (n, K); `before` (E, n, K), the clearance in the earlier\n"
    "steps, latest first; `motions` (E, 4, n), from the body frame of each step to that of the step\n"
    "before, as x, y, cosine and sine; `walked` (n,), the largest distance in metres that counts.\n"
    "Per sector: `cosine`, `sine`, `reach` (K,) and `ends` (K - 1,). Fills `came` (n,). `limits`: the\n"
    "largest clearance that is near, the largest that is a return, and the lidar's x.");

/* NaN is treated as in NumPy: `at_least` and `at_most` return a NaN in `a`, `least_of` a NaN in either. */
INLINE double at_least(double a, double bound) { return bound > a ? bound : a; }
INLINE double at_most(double a, double bound) { return bound < a ? bound : a; }
INLINE double least_of(double a, double b) { return a < b || a != a ? a : b; }

typedef struct {
    double *restrict step_x, *restrict step_y, *restrict length, *restrict along;
    double *restrict distance2, *restrict arc; /* (P - 1,), `arc` (P,) */
} Legs;

NARROW static void view_plan(const double *restrict plan, Size points, double x, double y, double cosine,
                             double sine, const double *ahead, Size looks, Legs at, double *out,
                             double *remaining, double *offset) {
    Size legs = points - 1, nearest = 0;
    for (Size i = 0; i < legs; i++) {
        double step_x = plan[2 * i + 2] - plan[2 * i], step_y = plan[2 * i + 3] - plan[2 * i + 1];
        double squared = step_x * step_x + step_y * step_y;
        double off_x = x - plan[2 * i], off_y = y - plan[2 * i + 1];
        double along = (off_x * step_x + off_y * step_y) / at_least(squared, 1e-12);
        along = at_most(at_least(along, 0.0), 1.0);
        double gap_x = off_x - along * step_x, gap_y = off_y - along * step_y;
        at.step_x[i] = step_x;
        at.step_y[i] = step_y;
        at.length[i] = sqrt(squared);
        at.along[i] = along;
        at.distance2[i] = gap_x * gap_x + gap_y * gap_y;
    }
    double least = at.distance2[0];
    at.arc[0] = 0.0;
    for (Size i = 0; i < legs; i++) {
        at.arc[i + 1] = at.arc[i] + at.length[i];
        least = least_of(at.distance2[i], least);
    }
    /* If the plan passes here twice, take the first time, even if the second is nearer by rounding. */
    double within = least + ROUNDING * (least + 0.1);
    while (nearest < legs && !(at.distance2[nearest] <= within))
        nearest++;
    if (nearest == legs)
        nearest = 0;
    double here = at.arc[nearest] + at.along[nearest] * at.length[nearest], total = at.arc[legs];
    for (Size look = 0; look < looks; look++) {
        double target = least_of(here + ahead[look], total);
        Size vertex = 0;
        for (Size i = 1; i < points; i++)
            vertex += at.arc[i] < target;
        vertex = vertex < legs ? vertex : legs - 1;
        double part = (target - at.arc[vertex]) / at_least(at.length[vertex], 1e-9);
        part = at_most(at_least(part, 0.0), 1.0);
        double ahead_x = plan[2 * vertex] + part * at.step_x[vertex] - x;
        double ahead_y = plan[2 * vertex + 1] + part * at.step_y[vertex] - y;
        out[2 * look] = cosine * ahead_x + sine * ahead_y;
        out[2 * look + 1] = -sine * ahead_x + cosine * ahead_y;
    }
    *remaining = total - here;
    *offset = sqrt(at.distance2[nearest]);
}

static PyObject *view_plans(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { PLANS, X, Y, COSINE, SINE, DISTANCES, LOOK_AHEAD, REMAINING, OFFSET, ALL };
    static const char *names[ALL] = {"plans", "x",          "y",         "cosine", "sine",
                                     "ahead", "look_ahead", "remaining", "offset"};
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    double *scratch = NULL;
    if (!PyArg_ParseTuple(args, "OOOOOOOOO", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &from[5], &from[6], &from[7], &from[8]))
        return NULL;
    int held = get_vectors(from, view, ALL, LOOK_AHEAD, names);
    if (held < ALL)
        goto done;
    Size count = view[X].shape[0], looks = view[DISTANCES].shape[0];
    Size points = count ? view[PLANS].shape[0] / (2 * count) : 2;
    int fits = points >= 2 && view[PLANS].shape[0] == 2 * count * points &&
               view[LOOK_AHEAD].shape[0] == 2 * count * looks;
    for (int each = Y; each < ALL; each++)
        fits = fits && (each == DISTANCES || each == LOOK_AHEAD || view[each].shape[0] == count);
    if (!fits) {
        wrong_shape("an argument");
        goto done;
    }
    if (!(scratch = malloc(6 * (size_t)points * sizeof(double)))) {
        PyErr_NoMemory();
        goto done;
    }
    Legs at = {scratch,
               scratch + points,
               scratch + 2 * points,
               scratch + 3 * points,
               scratch + 4 * points,
               scratch + 5 * points};
    const double *plans = view[PLANS].buf, *x = view[X].buf, *y = view[Y].buf;
    const double *cosine = view[COSINE].buf, *sine = view[SINE].buf;
    double *out = view[LOOK_AHEAD].buf, *remaining = view[REMAINING].buf, *offset = view[OFFSET].buf;
    Py_BEGIN_ALLOW_THREADS
    for (Size n = 0; n < count; n++)
        view_plan(plans + 2 * points * n, points, x[n], y[n], cosine[n], sine[n], view[DISTANCES].buf,
                  looks, at, out + 2 * looks * n, remaining + n, offset + n);
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    free(scratch);
    return released(view, held, answer);
}

/* The squared distance of points (count,) from a plan, and how far along the plan they are. */
NARROW static void project(const double *x, const double *y, Size count, const double *plan,
                           Size points, double *off2, double *along) {
    double passed = 0.0;
    for (Size k = 0; k < count; k++)
        off2[k] = INFINITY, along[k] = 0.0;
    for (Size leg = 0; leg + 1 < points; leg++) {
        double begin_x = plan[2 * leg], begin_y = plan[2 * leg + 1];
        double line_x = plan[2 * leg + 2] - begin_x, line_y = plan[2 * leg + 3] - begin_y;
        double length2 = at_least(line_x * line_x + line_y * line_y, 1e-12), length = sqrt(length2);
        for (Size k = 0; k < count; k++) {
            double off_x = x[k] - begin_x, off_y = y[k] - begin_y;
            double part = (off_x * line_x + off_y * line_y) / length2;
            part = at_most(at_least(part, 0.0), 1.0);
            double aside_x = off_x - part * line_x, aside_y = off_y - part * line_y;
            double aside2 = aside_x * aside_x + aside_y * aside_y;
            int nearer = aside2 < off2[k];
            off2[k] = nearer ? aside2 : off2[k];
            along[k] = nearer ? passed + part * length : along[k];
        }
        passed = passed + length;
    }
}

static PyObject *find_returns(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { X, Y, CLEARANCE, PLAN, WAY, GAP, ALL };
    static const char *names[ALL] = {"x", "y", "clearance", "plan", "way", "gap"};
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    double range, range2, on2, ahead, *scratch = NULL;
    if (!PyArg_ParseTuple(args, "OOOOOO(dddd)", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &from[5], &range, &range2, &on2, &ahead))
        return NULL;
    int held = get_vectors(from, view, ALL, WAY, names);
    if (held < ALL)
        goto done;
    Size count = view[WAY].shape[0];
    Size sectors = count ? view[X].shape[0] / count : 0;
    Size points = count ? view[PLAN].shape[0] / (2 * count) : 0;
    if ((count && points < 1) || view[X].shape[0] != count * sectors ||
        view[Y].shape[0] != count * sectors || view[CLEARANCE].shape[0] != count * sectors ||
        view[PLAN].shape[0] != 2 * count * points || view[GAP].shape[0] != count) {
        wrong_shape("an argument");
        goto done;
    }
    if (!(scratch = malloc(2 * (size_t)(sectors + 1) * sizeof(double)))) {
        PyErr_NoMemory();
        goto done;
    }
    const double *x = view[X].buf, *y = view[Y].buf, *clearance = view[CLEARANCE].buf;
    const double *plan = view[PLAN].buf;
    double *way = view[WAY].buf, *gap = view[GAP].buf, *off2 = scratch, *along = scratch + sectors;
    Py_BEGIN_ALLOW_THREADS
    for (Size n = 0; n < count; n++) {
        Size row = n * sectors;
        project(x + row, y + row, sectors, plan + 2 * points * n, points, off2, along);
        double first = INFINITY, nearest = INFINITY;
        for (Size k = 0; k < sectors; k++) {
            int seen = clearance[row + k] < range;
            first = least_of(seen && off2[k] <= on2 ? along[k] : range, first);
            nearest = least_of(seen && along[k] <= ahead ? off2[k] : range2, nearest);
        }
        way[n] = first;
        gap[n] = at_most(sqrt(nearest), range);
    }
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    free(scratch);
    return released(view, held, answer);
}

/* A monotonic function of the bearing of (x, y), in place of atan2: `surroundings._turned`. */
INLINE double turned(double x, double y) {
    double far = fabs(x) + fabs(y), part = y / (far > 0 ? far : 1.0);
    return x >= 0 ? part : y >= 0 ? 2.0 - part : -2.0 - part;
}

typedef struct {
    const double *cosine, *sine, *reach, *ends;
    Size count;
    double near, range, lever;
} Sectors;

/* How much nearer the return in one sector came, or 0. `before` and `motions` point to this robot's
 * values in the arrays of all `robots`. */
static double came_from(const Sectors *of, double clearance, Size sector, const double *before,
                        const double *motions, Size steps, Size robots) {
    double distance = clearance + of->reach[sector], came = INFINITY;
    double x = distance * of->cosine[sector] + of->lever, y = distance * of->sine[sector];
    for (Size step = 0; step < steps; step++, motions += 4 * robots) {
        double cosine = motions[2 * robots], sine = motions[3 * robots], was_x = x;
        x = motions[0] + cosine * was_x - sine * y;
        y = motions[robots] + sine * was_x + cosine * y;
        double x_of_lidar = x - of->lever, bearing = turned(x_of_lidar, y), farther = INFINITY;
        Size place = 0, left = of->count - 1; /* place: the number of `ends` up to the bearing */
        while (left > 0) {
            Size half = left / 2;
            if (bearing < of->ends[place + half])
                left = half;
            else {
                place += half + 1;
                left -= half + 1;
            }
        }
        for (Size beside = of->count - 1; beside <= of->count + 1; beside++) {
            Size around = (place + beside) % of->count;
            double seen = before[step * robots * of->count + around];
            if (seen < of->range && seen + of->reach[around] < farther)
                farther = seen + of->reach[around];
        }
        double gain = farther == INFINITY ? 0.0 : farther - hypot(x_of_lidar, y);
        came = least_of(gain, came);
        if (!(came > 0))
            return 0.0;
    }
    return came;
}

static PyObject *find_came(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { CLEARANCE, BEFORE, MOTIONS, WALKED, COSINE, SINE, REACH, ENDS, CAME, ALL };
    static const char *names[ALL] = {"clearance", "before", "motions", "walked", "cosine",
                                     "sine",      "reach",  "ends",    "came"};
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    Sectors of;
    if (!PyArg_ParseTuple(args, "OOOOOOOOO(ddd)", &from[0], &from[1], &from[2], &from[3], &from[4],
                          &from[5], &from[6], &from[7], &from[8], &of.near, &of.range, &of.lever))
        return NULL;
    int held = get_vectors(from, view, ALL, CAME, names);
    if (held < ALL)
        goto done;
    Size count = view[CAME].shape[0], sectors = view[REACH].shape[0];
    Size steps = count && sectors ? view[BEFORE].shape[0] / (count * sectors) : 0;
    if (sectors < 1 || (count && steps < 1) || view[CLEARANCE].shape[0] != count * sectors ||
        view[BEFORE].shape[0] != steps * count * sectors ||
        view[MOTIONS].shape[0] != 4 * steps * count || view[WALKED].shape[0] != count ||
        view[COSINE].shape[0] != sectors || view[SINE].shape[0] != sectors ||
        view[ENDS].shape[0] != sectors - 1) {
        wrong_shape("an argument");
        goto done;
    }
    const double *clearance = view[CLEARANCE].buf, *before = view[BEFORE].buf;
    const double *motions = view[MOTIONS].buf, *walked = view[WALKED].buf;
    double *came = view[CAME].buf;
    of.cosine = view[COSINE].buf;
    of.sine = view[SINE].buf;
    of.reach = view[REACH].buf;
    of.ends = view[ENDS].buf;
    of.count = sectors;
    Py_BEGIN_ALLOW_THREADS
    for (Size n = 0; n < count; n++) {
        const double *now = clearance + n * sectors, *last = before + n * sectors;
        int is_new = 0; /* a lidar slower than the steps repeats its scan, which shows no motion */
        for (Size k = 0; k < sectors; k++)
            is_new |= now[k] != last[k];
        came[n] = 0.0;
        for (Size k = 0; is_new && k < sectors; k++)
            if (now[k] < of.near) {
                double far = came_from(&of, now[k], k, last, motions + n, steps, count);
                if (far <= walked[n] && far > came[n])
                    came[n] = far;
            }
    }
    Py_END_ALLOW_THREADS
    answer = Py_NewRef(Py_None);
done:
    return released(view, held, answer);
}

PyDoc_STRVAR(
    near_boxes_doc,
    "near_boxes(x, y, shared, own, room, robots, within)\n--\n\n"
    "Compute `train.twin.floors.state_lattice.near_gap` for n robots, bit for bit.\n\n"
    "All arrays are flat float64. Lowers `room` (n, P) to the gaps between points `x`, `y` (n, P) and\n"
    "boxes, the `shared` (R, 4) and each robot's `own` (n, K, 4), if a gap is less than `within`.");

static void lower(const double *box, const double *x, const double *y, double *room, Size points) {
    for (Size i = 0; i < points; i++) {
        double aside = fabs(x[i] - box[0]) - box[2], along = fabs(y[i] - box[1]) - box[3];
        double far = aside > along ? aside : along;
        if (far < room[i]) {
            double gap = far > 0 ? hypot(aside > 0 ? aside : 0, along > 0 ? along : 0) : far;
            room[i] = gap < room[i] ? gap : room[i];
        }
    }
}

static PyObject *near_boxes(PyObject *Py_UNUSED(module), PyObject *args) {
    enum { X, Y, SHARED, OWN, ROOM, ALL };
    static const char *names[ALL] = {"x", "y", "shared", "own", "room"};
    PyObject *from[ALL], *answer = NULL;
    Py_buffer view[ALL];
    Size robots;
    double within;
    if (!PyArg_ParseTuple(args, "OOOOOnd", &from[0], &from[1], &from[2], &from[3], &from[4], &robots,
                          &within))
        return NULL;
    int held = get_vectors(from, view, ALL, ROOM, names);
    if (held < ALL)
        goto done;
    Size all = view[X].shape[0], points = robots > 0 ? all / robots : 0;
    Size shared = view[SHARED].shape[0] / 4, own = points ? view[OWN].shape[0] / 4 / robots : 0;
    if (robots * points != all || view[Y].shape[0] != all || view[ROOM].shape[0] != all ||
        view[SHARED].shape[0] != 4 * shared || view[OWN].shape[0] != 4 * own * robots) {
        wrong_shape("an argument");
        goto done;
    }
    for (Size n = 0; points && n < robots; n++) {
        const double *x = (const double *)view[X].buf + n * points;
        const double *y = (const double *)view[Y].buf + n * points;
        double low[2] = {x[0], y[0]}, high[2] = {x[0], y[0]};
        for (Size i = 1; i < points; i++) {
            low[0] = least_of(x[i], low[0]), high[0] = x[i] > high[0] ? x[i] : high[0];
            low[1] = least_of(y[i], low[1]), high[1] = y[i] > high[1] ? y[i] : high[1];
        }
        for (Size m = 0; m < shared + own; m++) {
            const double *box = (const double *)view[m < shared ? SHARED : OWN].buf;
            box += 4 * (m < shared ? m : n * own + m - shared);
            if (low[0] - within < box[0] + box[2] && high[0] + within > box[0] - box[2] &&
                low[1] - within < box[1] + box[3] && high[1] + within > box[1] - box[3])
                lower(box, x, y, (double *)view[ROOM].buf + n * points, points);
        }
    }
    answer = Py_NewRef(Py_None);
done:
    return released(view, held, answer);
}
