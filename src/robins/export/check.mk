# make check   compiles {name}.c and a test of it, and runs the test on recorded steps
# make stack   lists the stack of each function by itself (gcc, clang): add up the call chain
CC ?= cc
CFLAGS ?= -std=c99 -O2 -ffp-contract=off -Wall -Wextra -Wconversion -Wpedantic -Wdouble-promotion

.PHONY: check stack clean

check: test
	./test

test: test.c recorded.h {name}.c {name}.h
	$(CC) $(CFLAGS) -o test test.c {name}.c -lm

stack: {name}.c {name}.h
	$(CC) $(CFLAGS) -fstack-usage -c {name}.c
	cut -f 1,2 {name}.su

clean:
	rm -f test {name}.o {name}.su
