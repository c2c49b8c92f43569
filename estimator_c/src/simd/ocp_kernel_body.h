/* The bulk work of ocp_kernel.h on vec_... functions of VEC_WIDTH doubles; included by the generated ocp_net_*.c,
 * which have set both and OCP_KERNEL, the name of the table. */
#include <math.h>
#include <stddef.h>

#include "ocp_kernel.h"

enum { H = OCP_CELLS, WIDTH = VEC_WIDTH, GROUP = 4 };

static void pull_back(const double tape[], const double memory[], ocp_row_t row[], int rows)
{
    _Alignas(64) double k_i[OCP_PAD], k_f[OCP_PAD], k_g[OCP_PAD], k_o[OCP_PAD], by_h[OCP_PAD], forget[OCP_PAD];
    _Alignas(64) double z[4 * OCP_PAD], out[OCP_BACK];
    const vec_t one = vec_all(1.0);
#pragma GCC unroll 8
    for (int c = 0; c < H; c += WIDTH) {
        const vec_t i = vec_load(&tape[c]);
        const vec_t f = vec_load(&tape[H + c]);
        const vec_t g = vec_load(&tape[2 * H + c]);
        const vec_t o = vec_load(&tape[3 * H + c]);
        const vec_t t = vec_load(&tape[4 * H + c]);
        vec_store(&k_i[c], vec_mul(g, vec_mul(i, vec_sub(one, i))));
        vec_store(&k_f[c], vec_mul(vec_load(&memory[c]), vec_mul(f, vec_sub(one, f))));
        vec_store(&k_g[c], vec_mul(i, vec_fnma(g, g, one)));
        vec_store(&k_o[c], vec_mul(t, vec_mul(o, vec_sub(one, o))));
        vec_store(&by_h[c], vec_mul(o, vec_fnma(t, t, one)));
        vec_store(&forget[c], f);
    }
    for (int r = 0; r < rows; r++) {
        ocp_row_t *self = &row[r];
        const vec_t rate_0 = vec_all(NET_DT_S * self->theta[0]);
        const vec_t rate_1 = vec_all(NET_DT_S * self->theta[1]);
#pragma GCC unroll 8
        for (int c = 0; c < H; c += WIDTH) {
            const vec_t of_rates = vec_fma(rate_1, vec_load(&ocp_out[1][c]), vec_load(&self->h[c]));
            const vec_t h_bar = vec_fma(rate_0, vec_load(&ocp_out[0][c]), of_rates);
            const vec_t c_bar = vec_fma(h_bar, vec_load(&by_h[c]), vec_load(&self->c[c]));
            vec_store(&z[c], vec_mul(c_bar, vec_load(&k_i[c])));
            vec_store(&z[OCP_PAD + c], vec_mul(c_bar, vec_load(&k_f[c])));
            vec_store(&z[2 * OCP_PAD + c], vec_mul(c_bar, vec_load(&k_g[c])));
            vec_store(&z[3 * OCP_PAD + c], vec_mul(h_bar, vec_load(&k_o[c])));
            vec_store(&self->c[c], vec_mul(c_bar, vec_load(&forget[c])));
        }
#pragma GCC unroll 4
        for (int c = 0; c < OCP_BACK; c += WIDTH) {
            vec_t sum[4] = {vec_all(0.0), vec_all(0.0), vec_all(0.0), vec_all(0.0)}; /* one would wait for itself */
#pragma GCC unroll 8
            for (int j = 0; j < H; j++) {
#pragma GCC unroll 4
                for (int g = 0; g < 4; g++) {
                    const int at = g * OCP_PAD + j;
                    sum[g] = vec_fma(vec_all(z[at]), vec_load(&ocp_back[at][c]), sum[g]);
                }
            }
            vec_store(&out[c], vec_add(vec_add(sum[0], sum[1]), vec_add(sum[2], sum[3])));
        }
        for (int c = 0; c < H; c++) {
            self->h[c] = out[c];
        }
        for (int k = 0; k < 2; k++) {
            self->u[k] = out[OCP_PAD + k];
            self->theta[k] += out[OCP_PAD + 2 + k];
        }
    }
}

static void pull_back_one(const double tape[], const double memory[], ocp_row_t *row, ocp_bar_t *bar)
{
    for (int c = 0; c < H; c++) {
        const double of_rates = NET_DT_S * (row->theta[0] * ocp_out[0][c] + row->theta[1] * ocp_out[1][c]);
        bar->c[c] = row->c[c];
        bar->h[c] = row->h[c] + of_rates;
    }
    pull_back(tape, memory, row, 1);
}

/* The step's derivatives of one cell, numbers that all directions share. */
typedef struct {
    double i, f, g;                /* new c by the gates' arguments */
    double o_h, c_h;               /* new h by o's argument and by new c */
    double keep;                   /* new c by c */
    double ii, ig, gg, ff, fc, oo, oc, cc; /* second derivatives of what is asked for */
} cell_t;

static void differentiate(const double tape[], const double memory[], const ocp_bar_t *bar, cell_t cell[])
{
    for (int k = 0; k < H; k++) {
        const double i = tape[k], f = tape[H + k], g = tape[2 * H + k], o = tape[3 * H + k], t = tape[4 * H + k];
        const double di = i * (1.0 - i), df = f * (1.0 - f), dg = 1.0 - g * g, d_o = o * (1.0 - o), dt = 1.0 - t * t;
        const double h_bar = bar->h[k];
        const double c_bar = bar->c[k] + h_bar * o * dt;
        cell[k] = (cell_t){
            .i = g * di, .f = memory[k] * df, .g = i * dg, .o_h = t * d_o, .c_h = o * dt, .keep = f,
            .ii = c_bar * g * di * (1.0 - 2.0 * i), .ig = c_bar * di * dg, .gg = c_bar * i * dg * (-2.0 * g),
            .ff = c_bar * memory[k] * df * (1.0 - 2.0 * f), .fc = c_bar * df,
            .oo = h_bar * t * d_o * (1.0 - 2.0 * o), .oc = h_bar * d_o * dt, .cc = h_bar * o * dt * (-2.0 * t),
        };
    }
}

/* rows of a quadratic form: arguments of i, g, f, o, then c and new c, of each cell */
enum { PAD = 8, TILE = 4, FORMS = 6 * H };

/* TILE rows of curve, `vectors` (1 or 2) vectors wide, in registers while all forms pass. */
static inline __attribute__((always_inline)) void add_tile(const double left[][OCP_DIRECTIONS],
                                                           const double right[][OCP_DIRECTIONS], int a, int b,
                                                               int vectors,
                                                           double curve[][OCP_DIRECTIONS])
{
    vec_t sum[TILE][2];
#pragma GCC unroll 4
    for (int k = 0; k < TILE; k++) {
#pragma GCC unroll 2
        for (int c = 0; c < vectors; c++) {
            sum[k][c] = vec_load(&curve[a + k][b + c * WIDTH]);
        }
    }
    for (int r = 0; r < FORMS; r++) {
#pragma GCC unroll 4
        for (int k = 0; k < TILE; k++) {
            const vec_t scale = vec_all(left[r][a + k]);
#pragma GCC unroll 2
            for (int c = 0; c < vectors; c++) {
                sum[k][c] = vec_fma(scale, vec_load(&right[r][b + c * WIDTH]), sum[k][c]);
            }
        }
    }
#pragma GCC unroll 4
    for (int k = 0; k < TILE; k++) {
#pragma GCC unroll 2
        for (int c = 0; c < vectors; c++) {
            vec_store(&curve[a + k][b + c * WIDTH], sum[k][c]);
        }
    }
}

static void push(const double tape[], const double memory[], const ocp_bar_t *bar, const double of_torque[],
                 ocp_tangent_t *tangent, int directions, double curve[][OCP_DIRECTIONS])
{
    _Alignas(64) double left[FORMS][OCP_DIRECTIONS], right[FORMS][OCP_DIRECTIONS];
    cell_t cell[H];
    const int padded = (directions + PAD - 1) / PAD * PAD;
    differentiate(tape, memory, bar, cell);
    for (int d = 0; d < padded; d += WIDTH) {
        vec_t h[H], theta[2], torque = vec_load(&of_torque[d]);
        vec_t rate[2] = {vec_all(0.0), vec_all(0.0)};
#pragma GCC unroll 8
        for (int k = 0; k < H; k++) {
            h[k] = vec_load(&tangent->h[k][d]);
        }
        for (int ch = 0; ch < 2; ch++) {
            theta[ch] = vec_load(&tangent->theta[ch][d]);
        }
        for (int k = 0; k < H; k++) {
            vec_t z[4];
#pragma GCC unroll 4
            for (int g = 0; g < 4; g++) {
                const double *row = ocp_back[g * OCP_PAD + k];
                vec_t sum = vec_mul(vec_all(row[H + 1]), torque);
                vec_t other = vec_mul(vec_all(row[H + 2]), theta[0]);
                other = vec_fma(vec_all(row[H + 3]), theta[1], other);
#pragma GCC unroll 8
                for (int j = 0; j < H; j += 2) {
                    sum = vec_fma(vec_all(row[j]), h[j], sum);
                    other = vec_fma(vec_all(row[j + 1]), h[j + 1], other);
                }
                z[g] = vec_add(sum, other);
            }
            const cell_t *at = &cell[k];
            const vec_t c = vec_load(&tangent->c[k][d]);
            vec_t next = vec_mul(vec_all(at->keep), c);
            next = vec_fma(vec_all(at->i), z[0], next);
            next = vec_fma(vec_all(at->f), z[1], next);
            next = vec_fma(vec_all(at->g), z[2], next);
            const vec_t out = vec_fma(vec_all(at->c_h), next, vec_mul(vec_all(at->o_h), z[3]));
            vec_store(&tangent->c[k][d], next);
            vec_store(&tangent->h[k][d], out);
            rate[0] = vec_fma(vec_all(ocp_out[0][k]), out, rate[0]);
            rate[1] = vec_fma(vec_all(ocp_out[1][k]), out, rate[1]);
            const vec_t pair[6] = {z[0], z[2], z[1], c, z[3], next};
            const double form[3][3] = {{at->ii, at->ig, at->gg}, {at->ff, at->fc, 0.0}, {at->oo, at->oc, at->cc}};
#pragma GCC unroll 3
            for (int p = 0; p < 3; p++) {
                const vec_t a = pair[2 * p], b = pair[2 * p + 1], cross = vec_all(form[p][1]);
                vec_store(&left[6 * k + 2 * p][d], a);
                vec_store(&left[6 * k + 2 * p + 1][d], b);
                vec_store(&right[6 * k + 2 * p][d], vec_fma(vec_all(form[p][0]), a, vec_mul(cross, b)));
                vec_store(&right[6 * k + 2 * p + 1][d], vec_fma(cross, a, vec_mul(vec_all(form[p][2]), b)));
            }
        }
        for (int ch = 0; ch < 2; ch++) {
            vec_store(&tangent->theta[ch][d], vec_fma(vec_all(NET_DT_S), rate[ch], theta[ch]));
        }
    }
    for (int a = 0; a < padded; a += TILE) {
        int b = a - a % PAD;
        for (; b + 2 * WIDTH <= padded; b += 2 * WIDTH) {
            add_tile((const double (*)[OCP_DIRECTIONS])left, (const double (*)[OCP_DIRECTIONS])right, a, b, 2, curve);
        }
        for (; b < padded; b += WIDTH) {
            add_tile((const double (*)[OCP_DIRECTIONS])left, (const double (*)[OCP_DIRECTIONS])right, a, b, 1, curve);
        }
    }
}

/* to[j] += sum of sign scale[k] row_k[j] for j >= from; GROUP vectors at a time stay in registers. */
static inline void add_rows(double to[], int from, int n, const double row[][OCP_LD], const double scale[], int first,
                            int last)
{
    for (int j = from - from % WIDTH; j < n; j += GROUP * WIDTH) {
        vec_t sum[GROUP];
        const double *at = &row[first][j];
        if (j + (GROUP - 1) * WIDTH < n) {
#pragma GCC unroll 4
            for (int c = 0; c < GROUP; c++) {
                sum[c] = vec_load(&to[j + c * WIDTH]);
            }
            for (int k = first; k < last; k++, at += OCP_LD) {
                const vec_t s = vec_all(scale[k]);
#pragma GCC unroll 4
                for (int c = 0; c < GROUP; c++) {
                    sum[c] = vec_fma(s, vec_load(&at[c * WIDTH]), sum[c]);
                }
            }
#pragma GCC unroll 4
            for (int c = 0; c < GROUP; c++) {
                vec_store(&to[j + c * WIDTH], sum[c]);
            }
            continue;
        }
        for (int c = 0; j + c * WIDTH < n; c++) {
            vec_t one = vec_load(&to[j + c * WIDTH]);
            const double *column = at + c * WIDTH;
            for (int k = first; k < last; k++, column += OCP_LD) {
                one = vec_fma(vec_all(scale[k]), vec_load(column), one);
            }
            vec_store(&to[j + c * WIDTH], one);
        }
    }
}

static void gram(double h[][OCP_LD], int n, const double row[][OCP_LD], const int32_t support[],
                 const double weight[], int rows)
{
    double scale[2 * OCP_LD];
    int first = 0;
    for (int i = 0; i < n; i++) {
        while (first < rows && support[first] <= i) {
            first++;
        }
        for (int k = first; k < rows; k++) {
            scale[k] = weight[k] * row[k][i];
        }
        if (first < rows) {
            add_rows(h[i], i, n, row, scale, first, rows);
        }
    }
}

static bool factor(double a[][OCP_LD], int n)
{
    double scale[OCP_LD];
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) {
            scale[k] = -a[k][i];
        }
        add_rows(a[i], i, n, (const double (*)[OCP_LD])a, scale, 0, i);
        if (!(a[i][i] > 0.0)) {
            return false;
        }
        const double inverse = 1.0 / sqrt(a[i][i]);
        const vec_t all = vec_all(inverse);
        for (int j = i - i % WIDTH; j < n; j += WIDTH) {
            vec_store(&a[i][j], vec_mul(all, vec_load(&a[i][j])));
        }
        a[i][i] = inverse;
    }
    return true;
}

static void solve(const double a[][OCP_LD], int n, double x[])
{
    for (int i = 0; i < n; i++) {
        x[i] *= a[i][i];
        const double done = x[i];
        int j = i + 1;
        for (; j < n && j % WIDTH != 0; j++) {
            x[j] -= done * a[i][j];
        }
        for (; j < n; j += WIDTH) {
            vec_store(&x[j], vec_fnma(vec_all(done), vec_load(&a[i][j]), vec_load(&x[j])));
        }
    }
    for (int i = n - 1; i >= 0; i--) {
        vec_t sum = vec_all(0.0);
        double rest = x[i];
        int j = i + 1;
        for (; j < n && j % WIDTH != 0; j++) {
            rest -= a[i][j] * x[j];
        }
        for (; j < n; j += WIDTH) {
            sum = vec_fma(vec_load(&a[i][j]), vec_load(&x[j]), sum);
        }
        x[i] = a[i][i] * (rest - vec_sum(sum));
    }
}

const ocp_kernel_t OCP_KERNEL = {
    .name = OCP_KERNEL_NAME,
    .available = vec_available,
    .pull_back = pull_back,
    .pull_back_one = pull_back_one,
    .push = push,
    .gram = gram,
    .factor = factor,
    .solve = solve,
};
