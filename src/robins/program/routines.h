/* What is made of scalars: the same text for one number and for lanes. No branch on data but two:
   beyond FAR radians the sine is the C library's, and eigenvalues end when they are found. */

static inline real real_div(real a, real b) { return a / b; }

/* NaN if either is. */
static inline real real_max(real a, real b)
{
    return real_select(real_lt(b, a) | real_ne(a, a), a, b);
}

static inline real real_min(real a, real b)
{
    return real_select(real_lt(a, b) | real_ne(a, a), a, b);
}

static inline real real_sign(real a)
{
    const real down = real_select(real_lt(a, REAL(0.0)), REAL(-1.0), a);
    return real_select(real_lt(REAL(0.0), a), REAL(1.0), down);
}

static inline whole whole_abs(whole a) { return whole_select(whole_lt(a, WHOLE(0)), -a, a); }

static inline whole whole_sign(whole a)
{
    const whole down = whole_select(whole_lt(a, WHOLE(0)), WHOLE(-1), a);
    return whole_select(whole_lt(WHOLE(0), a), WHOLE(1), down);
}

static inline flag real_is_finite(real a) { return real_le(real_abs(a), REAL(DBL_MAX)); }

/* The total order of numbers: -0 before 0 is not told apart here, NaN comes last. */
static inline flag real_lt_to(real a, real b)
{
    return real_lt(a, b) | (real_ne(b, b) & real_eq(a, a));
}

static inline flag real_le_to(real a, real b) { return real_le(a, b) | real_ne(b, b); }

/* Sine and cosine of any angle, by `real_turned`, in whose file they are said to err how far. */
static inline real real_sin(real x)
{
    real s, c;
    whole k;
    const flag far = real_lt(FAR, real_abs(x));
    real_turned(x, &s, &c, &k);
    s = real_select(whole_ne(k & 1, WHOLE(0)), c, s);
    s = real_select(whole_ne(k & 2, WHOLE(0)), -s, s);
    if (ANY(far)) { s = real_select(far, real_far_sin(x), s); }
    return s;
}

static inline real real_cos(real x)
{
    real s, c;
    whole k;
    const flag far = real_lt(FAR, real_abs(x));
    real_turned(x, &s, &c, &k);
    c = real_select(whole_ne(k & 1, WHOLE(0)), s, c);
    c = real_select(whole_ne((k + 1) & 2, WHOLE(0)), -c, c);
    if (ANY(far)) { c = real_select(far, real_far_cos(x), c); }
    return c;
}

/* A B' of A (m, depth) and B (n, depth), which lie one after the other. */
static inline void product(int m, int depth, int n, real *in, real *out)
{
    const real *a = in, *b = in + m * depth;
    for (int i = 0; i < m; ++i) {
        for (int j = 0; j < n; ++j) {
            real sum = a[i * depth] * b[j * depth];
            for (int k = 1; k < depth; ++k) { sum = sum + a[i * depth + k] * b[j * depth + k]; }
            out[i * n + j] = sum;
        }
    }
}

/* Lower Cholesky factor of a symmetric matrix; all NaN where a pivot is not positive. */
static inline void cholesky(int n, real *in, real *out)
{
    flag positive = FLAG(1);
    for (int i = 0; i < n * n; ++i) { out[i] = REAL(0.0); }
    for (int j = 0; j < n; ++j) {
        for (int i = j; i < n; ++i) {
            real rest = in[i * n + j];
            for (int k = 0; k < j; ++k) { rest = rest - out[i * n + k] * out[j * n + k]; }
            if (i == j) {
                positive = positive & real_lt(REAL(0.0), rest);
                out[j * n + j] = real_sqrt(rest);
            } else {
                out[i * n + j] = rest / out[j * n + j];
            }
        }
    }
    for (int i = 0; i < n * n; ++i) { out[i] = real_select(positive, out[i], REAL(NAN)); }
}

/* L^-1 B of lower-triangular L (n, n) and B (n, width), which lie one after the other. */
static inline void solve_lower(int n, int width, real *in, real *out)
{
    const real *l = in, *b = in + n * n;
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < width; ++j) {
            real rest = b[i * width + j];
            for (int k = 0; k < i; ++k) { rest = rest - l[i * n + k] * out[k * width + j]; }
            out[i * width + j] = rest / l[i * n + i];
        }
    }
}

/* Add g v v' a to column j of a (rows from k to m, so many columns); v is column k of in. */
static inline void reflect(int m, int n, int columns, int k, int j, real g, const real *in, real *a)
{
    real along = in[k * n + k] * a[k * columns + j];
    for (int i = k + 1; i < m; ++i) { along = along + in[i * n + k] * a[i * columns + j]; }
    along = along * g;
    for (int i = k; i < m; ++i) {
        a[i * columns + j] = a[i * columns + j] + along * in[i * n + k];
    }
}

/* Q (m, width) and R (width, n) of a matrix (m, n), by reflections I + g v v', v = (alpha - beta,
   tail), g = -1 / (beta (beta - alpha)); the signs are LAPACK's. R is made in the place of the
   matrix, with the v in its lower triangle and its diagonal beside it. */
static inline void householder(int m, int n, int width, real *in, real *out)
{
    const int last = m - 1 < n ? m - 1 : n;
    real *q = out, *r = out + m * width;
    for (int i = 0; i < width * n; ++i) { r[i] = REAL(0.0); }
    for (int k = 0; k < last; ++k) {
        const real alpha = in[k * n + k];
        real below = REAL(0.0);
        for (int i = k + 1; i < m; ++i) { below = below + in[i * n + k] * in[i * n + k]; }
        const real length = real_sqrt(alpha * alpha + below);
        const real beta = real_select(real_lt(alpha, REAL(0.0)), length, -length);
        const flag nothing = real_lt(below, REAL(1e-290));
        const real head = alpha - beta;
        const real g = real_select(nothing, REAL(0.0),
                                   REAL(1.0) / real_select(nothing, REAL(1.0), beta * head));
        r[k * n + k] = real_select(nothing, alpha, beta);
        in[k * n + k] = head;
        for (int j = k + 1; j < n; ++j) { reflect(m, n, n, k, j, g, in, in); }
    }
    for (int i = 0; i < width; ++i) {
        for (int j = i < last ? i + 1 : i; j < n; ++j) { r[i * n + j] = in[i * n + j]; }
    }
    for (int i = 0; i < m; ++i) {
        for (int j = 0; j < width; ++j) { q[i * width + j] = REAL(i == j ? 1.0 : 0.0); }
    }
    for (int k = last - 1; k >= 0; --k) {
        real below = REAL(0.0);
        for (int i = k + 1; i < m; ++i) { below = below + in[i * n + k] * in[i * n + k]; }
        const flag nothing = real_lt(below, REAL(1e-290));
        const real h = r[k * n + k] * in[k * n + k];
        const real g = real_select(nothing, REAL(0.0),
                                   REAL(1.0) / real_select(nothing, REAL(1.0), h));
        for (int j = k; j < width; ++j) { reflect(m, n, width, k, j, g, in, q); }
    }
}

/* Vectors (n, n), as columns, and values (n) of a symmetric matrix, from least to greatest, by the
   cyclic rotations of Jacobi (Golub & Van Loan 2013, sec. 8.5); NaN where it is not finite. */
static inline void eigh(int n, real *in, real *out)
{
    real *v = out, *value = out + n * n;
    real sum = REAL(0.0);
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < n; ++j) {
            v[i * n + j] = REAL(i == j ? 1.0 : 0.0);
            sum = sum + real_abs(in[i * n + j]);
        }
    }
    const flag sound = real_is_finite(sum);
    for (int sweep = 0; sweep < 30; ++sweep) {
        real off = REAL(0.0);
        for (int i = 0; i < n; ++i) {
            for (int j = 0; j < i; ++j) { off = off + real_abs(in[i * n + j]); }
        }
        if (!ANY(sound & real_lt(sum * 1e-300, off))) { break; }
        for (int p = 0; p < n; ++p) {
            for (int q = p + 1; q < n; ++q) {
                const real apq = in[p * n + q], app = in[p * n + p], aqq = in[q * n + q];
                /* What is lost beside both of its neighbours on the diagonal is zero. */
                const flag small = real_eq(real_abs(app) + real_abs(apq) * 0.01, real_abs(app))
                                   & real_eq(real_abs(aqq) + real_abs(apq) * 0.01, real_abs(aqq));
                const flag none = small | real_eq(apq, REAL(0.0));
                const real theta = (aqq - app) / (real_select(none, REAL(1.0), apq) * 2.0);
                const real root = real_abs(theta) + real_sqrt(theta * theta + 1.0);
                real t = real_select(real_lt(theta, REAL(0.0)), REAL(-1.0), REAL(1.0)) / root;
                t = real_select(none, REAL(0.0), t);
                const real c = REAL(1.0) / real_sqrt(t * t + 1.0), s = t * c;
                for (int i = 0; i < n; ++i) {
                    const real x = in[i * n + p], y = in[i * n + q];
                    const real vx = v[i * n + p], vy = v[i * n + q];
                    in[i * n + p] = c * x - s * y;
                    in[i * n + q] = s * x + c * y;
                    v[i * n + p] = c * vx - s * vy;
                    v[i * n + q] = s * vx + c * vy;
                }
                for (int i = 0; i < n; ++i) {
                    const real x = in[p * n + i], y = in[q * n + i];
                    in[p * n + i] = c * x - s * y;
                    in[q * n + i] = s * x + c * y;
                }
                in[p * n + p] = app - t * apq;
                in[q * n + q] = aqq + t * apq;
                in[p * n + q] = REAL(0.0);
                in[q * n + p] = REAL(0.0);
            }
        }
    }
    for (int i = 0; i < n; ++i) { value[i] = in[i * n + i]; }
    for (int last = n - 1; last > 0; --last) {
        for (int k = 0; k < last; ++k) {
            const flag swap = real_lt(value[k + 1], value[k]);
            for (int i = 0; i <= n; ++i) { /* row n is the values */
                const real low = v[i * n + k], high = v[i * n + k + 1];
                v[i * n + k] = real_select(swap, high, low);
                v[i * n + k + 1] = real_select(swap, low, high);
            }
        }
    }
    for (int i = 0; i < n * n + n; ++i) { out[i] = real_select(sound, out[i], REAL(NAN)); }
}

/* L and U in one matrix (m, n), rows exchanged so that the greatest pivot comes first; the rows
   exchanged (min(m, n)), and the order that they make (m). */
static inline void lu(int m, int n, real *in, real *out)
{
    const int steps = m < n ? m : n;
    real *pivot = out + m * n, *order = pivot + steps;
    for (int i = 0; i < m * n; ++i) { out[i] = in[i]; }
    for (int i = 0; i < m; ++i) { order[i] = real_of_whole(WHOLE(i)); }
    for (int k = 0; k < steps; ++k) {
        real most = real_abs(out[k * n + k]);
        pivot[k] = real_of_whole(WHOLE(k));
        for (int i = k + 1; i < m; ++i) {
            const flag more = real_lt(most, real_abs(out[i * n + k]));
            most = real_select(more, real_abs(out[i * n + k]), most);
            pivot[k] = real_select(more, real_of_whole(WHOLE(i)), pivot[k]);
        }
        for (int i = k + 1; i < m; ++i) {
            const flag here = real_eq(pivot[k], real_of_whole(WHOLE(i)));
            for (int j = 0; j < n; ++j) {
                const real up = out[k * n + j], low = out[i * n + j];
                out[k * n + j] = real_select(here, low, up);
                out[i * n + j] = real_select(here, up, low);
            }
            const real up = order[k], low = order[i];
            order[k] = real_select(here, low, up);
            order[i] = real_select(here, up, low);
        }
        for (int i = k + 1; i < m; ++i) {
            const flag zero = real_eq(out[k * n + k], REAL(0.0));
            out[i * n + k] = out[i * n + k] / real_select(zero, REAL(1.0), out[k * n + k]);
            for (int j = k + 1; j < n; ++j) {
                out[i * n + j] = out[i * n + j] - out[i * n + k] * out[k * n + j];
            }
        }
    }
}
