/* The layers between a network's matrix products: bias, LayerNorm (arXiv:1607.06450) and ReLU.
 *
 * A sum over a row is computed as LANES partial sums that are then folded; a sum over a batch is
 * computed row by row. So the order of additions, and the result, are the same with AVX2 and AVX-512.
 */
#pragma once
#include "buffers.h"

#define LANES 16 /* partial sums of a row; parameters are aligned to so many floats */

typedef float Lanes __attribute__((vector_size(64), aligned(4), may_alias));
typedef int Masks __attribute__((vector_size(64), aligned(4), may_alias));

#define EACH_LANES(i, n, width)                                                                   \
    for (Size i = 0, n; i < (width) && (n = (width)-i < LANES ? (width)-i : LANES); i += LANES)

/* Load n floats; the rest of the LANES are 0. */
INLINE Lanes load(const float *from, Size n) {
    if (n == LANES)
        return *(const Lanes *)from;
    Lanes some = {0};
    memcpy(&some, from, sizeof(float) * (size_t)n);
    return some;
}

INLINE void store(float *to, Lanes value, Size n) {
    if (n == LANES)
        *(Lanes *)to = value;
    else
        memcpy(to, &value, sizeof(float) * (size_t)n);
}

INLINE float fold(Lanes sums) {
    float part[LANES];
    memcpy(part, &sums, sizeof part);
    for (int width = LANES / 2; width; width /= 2)
        for (int i = 0; i < width; i++)
            part[i] += part[i + width];
    return part[0];
}

/* `value` where `by` is above 0 or NaN (as in PyTorch), else 0. */
INLINE Lanes where_positive(Lanes value, Lanes by) {
    Masks keeps = ~(by <= 0);
    return (Lanes)((Masks)value & keeps);
}

/* The tensors of a hidden layer. Its input is z (n, H), without bias. */
typedef struct {
    Size width;
    const float *bias, *gain, *shift; /* (H,); gain and shift NULL without LayerNorm */
    float *d_bias, *d_gain, *d_shift; /* (H,), their gradients */
    float *normed;                    /* (n, H) z, then (z - mean) / deviation; NULL: no LayerNorm */
    float *after;                     /* (n, H), the output */
    float *inverse;                   /* (n,) 1 / deviation */
    float eps;
} Hidden;

INLINE void activate(const Hidden *layer, Size rows) {
    Size width = layer->width;
    for (Size row = 0; row < rows; row++) {
        float *h = layer->after + row * width;
        if (!layer->normed) {
            EACH_LANES(i, n, width) {
                Lanes v = load(h + i, n) + load(layer->bias + i, n);
                store(h + i, where_positive(v, v), n);
            }
            continue;
        }
        float *z = layer->normed + row * width;
        Lanes sum = {0}, squares = {0};
        EACH_LANES(i, n, width) {
            Lanes v = load(z + i, n) + load(layer->bias + i, n);
            store(z + i, v, n);
            sum += v;
        }
        float mean = fold(sum) / (float)width;
        EACH_LANES(i, n, width) {
            store(z + i, load(z + i, n) - mean, n);
            Lanes apart = load(z + i, n);
            squares += apart * apart;
        }
        float variance = fold(squares) / (float)width + layer->eps;
        float inverse = 1.0f / _mm_cvtss_f32(_mm_sqrt_ss(_mm_set_ss(variance)));
        layer->inverse[row] = inverse;
        EACH_LANES(i, n, width) {
            Lanes v = load(z + i, n) * inverse;
            store(z + i, v, n);
            v = v * load(layer->gain + i, n) + load(layer->shift + i, n);
            store(h + i, where_positive(v, v), n);
        }
    }
}

/* Turn the gradient of the output (n, H) into that of z, in place; fill the parameters' gradients. */
INLINE void activate_back(const Hidden *layer, float *gradient, Size rows) {
    Size width = layer->width;
    size_t bytes = sizeof(float) * (size_t)width;
    memset(layer->d_bias, 0, bytes);
    if (layer->normed) {
        memset(layer->d_gain, 0, bytes);
        memset(layer->d_shift, 0, bytes);
    }
    for (Size row = 0; row < rows; row++) {
        float *g = gradient + row * width;
        const float *h = layer->after + row * width;
        if (!layer->normed) {
            EACH_LANES(i, n, width) {
                Lanes u = where_positive(load(g + i, n), load(h + i, n));
                store(g + i, u, n);
                store(layer->d_bias + i, load(layer->d_bias + i, n) + u, n);
            }
            continue;
        }
        const float *x = layer->normed + row * width;
        Lanes sum = {0}, along = {0};
        EACH_LANES(i, n, width) {
            Lanes u = where_positive(load(g + i, n), load(h + i, n)), v = load(x + i, n);
            store(layer->d_shift + i, load(layer->d_shift + i, n) + u, n);
            store(layer->d_gain + i, load(layer->d_gain + i, n) + u * v, n);
            u *= load(layer->gain + i, n);
            store(g + i, u, n);
            sum += u;
            along += u * v;
        }
        float mean = fold(sum) / (float)width, slope = fold(along) / (float)width;
        float inverse = layer->inverse[row];
        EACH_LANES(i, n, width) {
            Lanes u = (load(g + i, n) - mean - load(x + i, n) * slope) * inverse;
            store(g + i, u, n);
            store(layer->d_bias + i, load(layer->d_bias + i, n) + u, n);
        }
    }
}

WIDE static void wide_activate(const Hidden *layer, Size rows) { activate(layer, rows); }
WIDE static void wide_back(const Hidden *layer, float *g, Size rows) {
    activate_back(layer, g, rows);
}
NARROW static void narrow_activate(const Hidden *layer, Size rows) { activate(layer, rows); }
NARROW static void narrow_back(const Hidden *layer, float *g, Size rows) {
    activate_back(layer, g, rows);
}


typedef struct {
    void (*activate)(const Hidden *, Size);
    void (*back)(const Hidden *, float *, Size);
} Rows;

static const Rows WIDE_ROWS = {wide_activate, wide_back};
static const Rows NARROW_ROWS = {narrow_activate, narrow_back};
