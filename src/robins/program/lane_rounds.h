/* Behind a program, whose counts of numbers are NX, NK (taken) and NY, NM (given). */
extern "C" int robins_scan(const scan *s)
{
    real x[NX], y[NY];
    whole k[NK], m[NM];
    return scanned<LANES>(s, robins_step, x, k, y, m);
}
extern "C" int robins_lanes(void) { return LANES; }
