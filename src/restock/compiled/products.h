/* Matrix products by tiles of a few rows and PANEL columns, which are held in registers.
 *
 * The terms of an element are added one after the other with fused multiply-adds, so that AVX2 and
 * AVX-512 give the same bits.
 */
#pragma once
#include "buffers.h"

#define PANEL 32    /* columns of a tile */
#define MAX_ROWS 8 /* rows of a tile, at most */

/* Computes a tile. Element (m, k) of the left matrix is a[m * row + k * column]; the right matrix is
 * packed to (K, PANEL). */
typedef void Tile(const float *a, Size row, Size column, const float *b, Size depth, float *out,
                  Size stride);

#define UNROLLED _Pragma("GCC unroll 8") for (int r = 0; r < ROWS; r++)

#define WIDE_TILE(ROWS_)                                                                          \
    WIDE static void wide_tile_##ROWS_(const float *a, Size row, Size column, const float *b,     \
                                       Size depth, float *out, Size stride) {                     \
        enum { ROWS = ROWS_ };                                                                    \
        __m512 left[ROWS], right[ROWS];                                                           \
        UNROLLED left[r] = right[r] = _mm512_setzero_ps();                                        \
        for (Size k = 0; k < depth; k++, a += column, b += PANEL) {                               \
            __m512 first = _mm512_loadu_ps(b), second = _mm512_loadu_ps(b + 16);                  \
            UNROLLED {                                                                            \
                __m512 factor = _mm512_set1_ps(a[r * row]);                                       \
                left[r] = _mm512_fmadd_ps(factor, first, left[r]);                                \
                right[r] = _mm512_fmadd_ps(factor, second, right[r]);                             \
            }                                                                                     \
        }                                                                                         \
        UNROLLED {                                                                                \
            _mm512_storeu_ps(out + r * stride, left[r]);                                          \
            _mm512_storeu_ps(out + r * stride + 16, right[r]);                                    \
        }                                                                                         \
    }

#define NARROW_TILE(ROWS_)                                                                        \
    NARROW static void narrow_tile_##ROWS_(const float *a, Size row, Size column, const float *b, \
                                           Size depth, float *out, Size stride) {                 \
        enum { ROWS = ROWS_ };                                                                    \
        for (int half = 0; half < PANEL; half += 16) {                                            \
            const float *p = a, *q = b + half;                                                    \
            __m256 left[ROWS], right[ROWS];                                                       \
            UNROLLED left[r] = right[r] = _mm256_setzero_ps();                                    \
            for (Size k = 0; k < depth; k++, p += column, q += PANEL) {                           \
                __m256 first = _mm256_loadu_ps(q), second = _mm256_loadu_ps(q + 8);               \
                UNROLLED {                                                                        \
                    __m256 factor = _mm256_set1_ps(p[r * row]);                                   \
                    left[r] = _mm256_fmadd_ps(factor, first, left[r]);                            \
                    right[r] = _mm256_fmadd_ps(factor, second, right[r]);                         \
                }                                                                                 \
            }                                                                                     \
            UNROLLED {                                                                            \
                _mm256_storeu_ps(out + r * stride + half, left[r]);                               \
                _mm256_storeu_ps(out + r * stride + half + 8, right[r]);                          \
            }                                                                                     \
        }                                                                                         \
    }

WIDE_TILE(8)
WIDE_TILE(1)
NARROW_TILE(6)
NARROW_TILE(1)

/* Pack `count` columns of the right matrix, whose element (k, n) is b[k * row + n * column], into a
 * panel (depth, PANEL); missing columns are zeros. `row` or `column` is 1. */
static void pack(const float *b, Size row, Size column, Size depth, Size count, float *to) {
    if (count < PANEL)
        memset(to, 0, sizeof(float) * (size_t)(depth * PANEL));
    if (column == 1) {
        for (Size k = 0; k < depth; k++)
            memcpy(to + k * PANEL, b + k * row, sizeof(float) * (size_t)count);
        return;
    }
    for (Size j = 0; j < count;) {
        const float *from = b + j * column;
        Size k = 0;
        if (j + 4 > count) {
            for (; k < depth; k++)
                to[k * PANEL + j] = from[k];
            j++;
            continue;
        }
        for (; k + 4 <= depth; k += 4) {
            __m128 p = _mm_loadu_ps(from + k), q = _mm_loadu_ps(from + column + k);
            __m128 r = _mm_loadu_ps(from + 2 * column + k);
            __m128 s = _mm_loadu_ps(from + 3 * column + k);
            _MM_TRANSPOSE4_PS(p, q, r, s);
            float *at = to + k * PANEL + j;
            _mm_storeu_ps(at, p);
            _mm_storeu_ps(at + PANEL, q);
            _mm_storeu_ps(at + 2 * PANEL, r);
            _mm_storeu_ps(at + 3 * PANEL, s);
        }
        for (; k < depth; k++)
            for (int i = 0; i < 4; i++)
                to[k * PANEL + j + i] = from[i * column + k];
        j += 4;
    }
}

typedef struct {
    Size rows; /* of `tile`; `single` has one */
    Tile *tile, *single;
} Tiles;

static const Tiles WIDE_TILES = {MAX_ROWS, wide_tile_8, wide_tile_1};
static const Tiles NARROW_TILES = {6, narrow_tile_6, narrow_tile_1};

/* out (rows, width) = left (rows, depth) right (depth, width); see `Tile` and `pack`. Every panel is
 * packed into the same memory: more memory would evict the data of the next steps from the caches. */
static void multiply(const Tiles *by, const float *left, Size left_row, Size left_column,
                     const float *right, Size right_row, Size right_column, float *out, Size rows,
                     Size width, Size depth, float *panel) {
    float narrow[MAX_ROWS * PANEL];
    for (Size n = 0; n < width; n += PANEL) {
        Size count = width - n < PANEL ? width - n : PANEL;
        pack(right + n * right_column, right_row, right_column, depth, count, panel);
        for (Size m = 0, made; m < rows; m += made) {
            const float *from = left + m * left_row;
            float *to = count == PANEL ? out + m * width + n : narrow;
            Size stride = count == PANEL ? width : PANEL;
            made = rows - m >= by->rows ? by->rows : 1;
            (made > 1 ? by->tile : by->single)(from, left_row, left_column, panel, depth, to,
                                               stride);
            if (count < PANEL)
                for (Size r = 0; r < made; r++)
                    memcpy(out + (m + r) * width + n, narrow + r * PANEL,
                           sizeof(float) * (size_t)count);
        }
    }
}
