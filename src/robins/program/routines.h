/* What is made of scalars: the same text for one number and for lanes. No branch on data but three:
   beyond FAR radians the sine is the C library's, eigenvalues end when they are found, and what is
   far out in the tail of an error function has polynomials of its own. */

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

/* The total order of numbers: -0 and 0 are not distinguished here, NaN comes last. */
static inline flag real_lt_to(real a, real b)
{
    return real_lt(a, b) | (real_ne(b, b) & real_eq(a, a));
}

static inline flag real_le_to(real a, real b) { return real_le(a, b) | real_ne(b, b); }

/* Sine and cosine of any angle, by `real_turned`, in whose file their errors are stated. */
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

/* The same whole number but for whole rounds of 2 half, from -half to half - 1. */
static inline whole whole_wrap(whole a, whole half)
{
    return ((a + half) & (half + half - 1)) - half;
}

/* Four rounds of Threefry 2x32, which turn the second word by so many bits. */
static inline void four_rounds(word *x, word *y, int a, int b, int c, int d)
{
    *x = *x + *y;
    *y = ((*y << a) | (*y >> (32 - a))) ^ *x;
    *x = *x + *y;
    *y = ((*y << b) | (*y >> (32 - b))) ^ *x;
    *x = *x + *y;
    *y = ((*y << c) | (*y >> (32 - c))) ^ *x;
    *x = *x + *y;
    *y = ((*y << d) | (*y >> (32 - d))) ^ *x;
}

/* Threefry 2x32 in 20 rounds (Salmon et al., SC 2011): of a key and a number, the first of their
   two words above the second, 64 bits that look like chance. */
static inline word64 word64_threefry(word64 key, word64 number)
{
    const word a = word_of_word64(key >> 32), b = word_of_word64(key);
    const word c = a ^ b ^ WORD(0x1BD11BDAu);
    word x = word_of_word64(number >> 32) + a, y = word_of_word64(number) + b;
    four_rounds(&x, &y, 13, 15, 26, 6);
    x = x + b;
    y = y + c + WORD(1u);
    four_rounds(&x, &y, 17, 29, 16, 24);
    x = x + c;
    y = y + a + WORD(2u);
    four_rounds(&x, &y, 13, 15, 26, 6);
    x = x + a;
    y = y + b + WORD(3u);
    four_rounds(&x, &y, 17, 29, 16, 24);
    x = x + b;
    y = y + c + WORD(4u);
    four_rounds(&x, &y, 13, 15, 26, 6);
    x = x + c;
    y = y + a + WORD(5u);
    return (word64_of_word(x) << 32) | word64_of_word(y);
}

/* The logarithm of a positive normal number: 2^k m with m about 1, and 2 artanh((m - 1)/(m + 1)) by
   its series, to 0.03^11 / 23 of it. */
static inline real logarithm(real a)
{
    const word64 bits = word64_bits_real(a);
    real m = real_bits_word64((bits & 0xFFFFFFFFFFFFFu) | 0x3FE0000000000000u);
    real k = real_of_whole(whole_of_word64(bits >> 52)) - 1022.0;
    const flag low = real_lt(m, REAL(0.7071067811865476));
    m = real_select(low, m + m, m);
    k = real_select(low, k - 1.0, k);
    const real f = m - 1.0, s = f / (m + 1.0), z = s * s;
    real p = z * 0.09523809523809523 + 0.10526315789473684;
    p = ((p * z + 0.11764705882352941) * z + 0.13333333333333333) * z + 0.15384615384615385;
    p = ((p * z + 0.18181818181818182) * z + 0.2222222222222222) * z + 0.2857142857142857;
    p = (p * z + 0.4) * z + 0.6666666666666666;
    /* 2 s = f - s f, and ln 2 in two parts, of which the first times k is exact. */
    return k * 0.6931471803691238 + (f + (s * (z * p - f) + k * 1.9082149292705877e-10));
}

/* The inverse of the error function as XLA computes it: polynomials in w = -log(1 - x^2) (Giles
   2012), and w for w < 0.53 by the rational function of Cephes (Moshier 1989), which is meant for
   w < 0.35 and is off by 1e-14 at the end; numbers equal to JAX's are wanted. */
static inline real real_erf_inv(real x)
{
    const real y = -(x * x), yy = y * y, size = real_abs(x);
    real top = y * 4.52700008624452e-05 + 0.49854102823193375;
    top = ((top * y + 6.578732594206104) * y + 29.911919328553072) * y + 60.94966798098779;
    top = (top * y + 57.11296359058554) * y + 20.039553499201283;
    real low = y * 1.0 + 15.062909083469192;
    low = ((low * y + 83.04756596796722) * y + 221.76239823732857) * y + 309.09872225312057;
    low = (low * y + 216.42788614495947) * y + 60.11866049760384;
    const real near = y + (yy * -0.5 + (y * yy) * (top / low));
    const flag is_near = real_lt(real_abs(y), REAL(0.4142135623730951));
    const real w = -real_select(is_near, near, logarithm(y + 1.0));
    const real z = w - 3.125;
    real p = z * -3.64441206401782e-21 - 1.6850591381820166e-19;
    p = ((p * z + 1.28584807152564e-18) * z + 1.1157877678025181e-17) * z - 1.333171662854621e-16;
    p = ((p * z + 2.0972767875968562e-17) * z + 6.637638134358324e-15) * z - 4.054566272975207e-14;
    p = ((p * z - 8.151934197605472e-14) * z + 2.6335093153082323e-12) * z - 1.2975133253453532e-11;
    p = ((p * z - 5.415412054294628e-11) * z + 1.0512122733215323e-09) * z - 4.112633980346984e-09;
    p = ((p * z - 2.9070369957882005e-08) * z + 4.2347877827932404e-07)
        * z - 1.3654692000834679e-06;
    p = ((p * z - 1.3882523362786469e-05) * z + 0.00018673420803405714) * z - 0.000740702534166267;
    p = ((p * z - 0.006033670871430149) * z + 0.24015818242558962) * z + 1.6536545626831027;
    const flag tail = real_le(REAL(6.25), w);
    if (ANY(tail)) {
        const flag middle = real_lt(w, REAL(16.0));
        const real root = real_sqrt(w), t = root - 3.25, u = root - 5.0;
        real q = t * 2.2137376921775787e-09 + 9.075656193888539e-08;
        q = ((q * t - 2.7517406297064545e-07) * t + 1.8239629214389228e-08)
            * t + 1.5027403968909828e-06;
        q = ((q * t - 4.013867526981546e-06) * t + 2.9234449089955446e-06)
            * t + 1.2475304481671779e-05;
        q = ((q * t - 4.7318229009055734e-05) * t + 6.828485145957318e-05)
            * t + 2.4031110387097894e-05;
        q = ((q * t - 0.0003550375203628475) * t + 0.0009532893797373805)
            * t - 0.0016882755560235047;
        q = ((q * t + 0.002491442096107851) * t - 0.003751208507569241) * t + 0.005370914553590064;
        q = (q * t + 1.0052589676941592) * t + 3.0838856104922208;
        real r = u * -2.7109920616438573e-11 - 2.555641816996525e-10;
        r = ((r * u + 1.5076572693500548e-09) * u - 3.789465440126737e-09)
            * u + 7.61570120807834e-09;
        r = ((r * u - 1.496002662714924e-08) * u + 2.914795345090108e-08)
            * u - 6.771199775845234e-08;
        r = ((r * u + 2.2900482228026655e-07) * u - 9.9298272942317e-07)
            * u + 4.526062597223154e-06;
        r = ((r * u - 1.968177810553167e-05) * u + 7.599527703001776e-05)
            * u - 0.00021503011930044477;
        r = ((r * u - 0.00013871931833623122) * u + 1.0103004648645344) * u + 4.849906401408584;
        p = real_select(tail, real_select(middle, q, r), p);
    }
    p = real_select(real_eq(size, REAL(1.0)), REAL(INFINITY), p);
    return real_select(real_lt(REAL(1.0), size), REAL(NAN), p * x);
}

/* A B' of A (m, depth) and B (n, depth). Here and in `reflect` four
   sums go side by side, so that each need not wait for its last addition; each is in order. */
static inline void product(int m, int depth, int n, const real *a, const real *b0, real *out)
{
    for (int i = 0; i < m; ++i, a += depth) {
        const real *b = b0;
        for (int left = n; left > 0; --left, b += depth) {
            if (left >= 4) {
                const real *p = b + depth, *q = p + depth, *r = q + depth;
                real s0 = a[0] * b[0], s1 = a[0] * p[0], s2 = a[0] * q[0], s3 = a[0] * r[0];
                for (int k = 1; k < depth; ++k) {
                    s0 = s0 + a[k] * b[k];
                    s1 = s1 + a[k] * p[k];
                    s2 = s2 + a[k] * q[k];
                    s3 = s3 + a[k] * r[k];
                }
                *out++ = s0;
                *out++ = s1;
                *out++ = s2;
                *out++ = s3;
                left -= 3;
                b = r;
            } else {
                real sum = a[0] * b[0];
                for (int k = 1; k < depth; ++k) { sum = sum + a[k] * b[k]; }
                *out++ = sum;
            }
        }
    }
}

/* Lower Cholesky factor of a symmetric matrix; all NaN where a pivot is not positive. The order of
   operations is that of the same factor written out as scalars. */
static inline void cholesky(int n, const real *in, real *out)
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

/* L^-1 B of lower-triangular L (n, n) and B (n, width). */
static inline void solve_lower(int n, int width, const real *l, const real *b, real *out)
{
    for (int i = 0; i < n; ++i) {
        for (int j = 0; j < width; ++j) {
            real rest = b[i * width + j];
            for (int k = 0; k < i; ++k) { rest = rest - l[i * n + k] * out[k * width + j]; }
            out[i * width + j] = rest / l[i * n + i];
        }
    }
}

/* Add g v v' a to the columns of a from j on (rows from k to m); v is column k of in (m, n). */
static inline void reflect(int m, int n, int columns, int k, int j, real g, const real *in, real *a)
{
    const real head = in[k * n + k];
    for (; j + 4 <= columns; j += 4) {
        real *row = a + k * columns + j;
        real s0 = head * row[0], s1 = head * row[1], s2 = head * row[2], s3 = head * row[3];
        for (int i = k + 1; i < m; ++i) {
            const real v = in[i * n + k];
            row += columns;
            s0 = s0 + v * row[0];
            s1 = s1 + v * row[1];
            s2 = s2 + v * row[2];
            s3 = s3 + v * row[3];
        }
        s0 = s0 * g;
        s1 = s1 * g;
        s2 = s2 * g;
        s3 = s3 * g;
        row = a + k * columns + j;
        for (int i = k; i < m; ++i, row += columns) {
            const real v = in[i * n + k];
            row[0] = row[0] + s0 * v;
            row[1] = row[1] + s1 * v;
            row[2] = row[2] + s2 * v;
            row[3] = row[3] + s3 * v;
        }
    }
    for (; j < columns; ++j) {
        real along = head * a[k * columns + j];
        for (int i = k + 1; i < m; ++i) { along = along + in[i * n + k] * a[i * columns + j]; }
        along = along * g;
        for (int i = k; i < m; ++i) {
            a[i * columns + j] = a[i * columns + j] + along * in[i * n + k];
        }
    }
}

/* R (width, n) of the QR of a matrix (m, n), by reflections I + g v v', v = (alpha - beta, tail),
   g = -1 / (beta (beta - alpha)); the signs are LAPACK's. R is made in the place of the matrix,
   with the v in its lower triangle and its diagonal separately. */
static inline void triangle(int m, int n, int width, real *in, real *r)
{
    const int last = m - 1 < n ? m - 1 : n;
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
        reflect(m, n, n, k, k + 1, g, in, in);
    }
    for (int i = 0; i < width; ++i) {
        for (int j = i < last ? i + 1 : i; j < n; ++j) { r[i * n + j] = in[i * n + j]; }
    }
}

/* Q (m, width) and R (width, n) of a matrix (m, n), by the reflections of `triangle`. */
static inline void householder(int m, int n, int width, real *in, real *out)
{
    const int last = m - 1 < n ? m - 1 : n;
    real *q = out, *r = out + m * width;
    triangle(m, n, width, in, r);
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
        reflect(m, n, width, k, k, g, in, q);
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
                /* What is lost against both of its neighbours on the diagonal is zero. */
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
static inline void lu(int m, int n, const real *in, real *out)
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
