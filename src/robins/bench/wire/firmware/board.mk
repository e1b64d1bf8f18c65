# make -f board.mk adm_board    builds a part of the bench for this machine, to be run with a port
CC ?= cc
CFLAGS ?= -std=c99 -O2 -Wall -Wextra

# the numbers of a filter are those of the host where a product and a sum are rounded apart
%_board: %_board.c platform_posix.c part_loop.h platform.h robins_wire.h
	$(CC) $(CFLAGS) -ffp-contract=off -o $@ $< $(wildcard robins.c filter.c) platform_posix.c -lm
