#pragma once
#define NAN __builtin_nanf("")
#define HUGE_VAL __builtin_huge_val()
#define isfinite(x) __builtin_isfinite(x)
#define fabs(x) __builtin_fabs(x)

double ldexp(double x, int exponent);
