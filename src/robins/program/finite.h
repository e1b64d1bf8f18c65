#if defined(__FAST_MATH__) || defined(_M_FP_FAST) || \
    (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "NaN means missing here: compile without -ffast-math and -ffinite-math-only"
#endif
