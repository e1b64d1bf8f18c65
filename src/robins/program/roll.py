"""What is computed alike many times, found again as loops.

A jaxpr says once what is done to all sigma points, or to all samples of an IMU; a graph of scalars
says it for each. Here equal trees of operations are walked in step, from arrays that the function
had: K nodes of one operation are a *pack*, if their arguments are packs, or one node, or K nodes
from elsewhere. Packs that feed each other are one loop of K rounds (the packing is that of
superword-level parallelism, Larsen & Amarasinghe 2000; here the words are rounds).
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

from robins.program.layout import Layout, Pack, Roll
from robins.program.nodes import Graph, Node
from robins.program.operations import OPERATIONS

FEWEST = 8  # rounds of a loop
LEAST = 3  # operations in a round, and so many times the arrays that are gathered for it

PACKED = {*OPERATIONS, "select", "convert", "bits"}


Seeds = Iterable[tuple[Node, ...]]


class Packing:
    """Packs and loops among the live nodes of a graph."""

    def __init__(
        self, graph: Graph, live: Sequence[Node], roots: set[Node], seeds: Seeds, unroll: int = 0
    ):
        """Pack live nodes, from rows that may be alike; roots are read where all is done.

        What is not more than so many operations in all rounds is written out.
        """
        self.unroll = unroll
        self.graph, self.live, self.roots = graph, set(live), roots
        self.place: dict[Node, tuple[Pack, int]] = {}  # of a node in a pack: which round
        self.layout = Layout(graph, live, self.place, roots)
        # What says whether a loop goes on is computed before all else in it.
        loops = [graph.value[n] for n in live if graph.op[n] == "loop"]
        going = [loop.condition for loop in loops if loop.condition is not None]
        self.first = {n for n in graph.live(going) if graph.scope[n] > 0}
        for nodes in sorted(set(seeds), key=lambda s: (-len(s), -s[0])):
            self._pack(nodes)
        self.suspects = self.live
        while self._dissolve_circles():
            pass
        self._join()
        while self._dissolve_small():
            self._join()
        self._mark_kept()

    # --------------------------------------------------------------------------------- packs

    def _pack(self, nodes: tuple[Node, ...]) -> None:
        """Pack some nodes, and what they are made of."""
        ahead = [nodes]
        while ahead:
            nodes = ahead.pop()
            if self._may_be_packed(nodes):
                pack = Pack(nodes)
                self.place.update((n, (pack, k)) for k, n in enumerate(nodes))
                ahead += zip(*(self.graph.args[n] for n in nodes), strict=True)

    def _may_be_packed(self, nodes: tuple[Node, ...]) -> bool:
        graph, first = self.graph, nodes[0]
        if len(nodes) < FEWEST or graph.op[first] not in PACKED or first in self.place:
            return False
        if len(set(nodes)) < len(nodes):
            return False
        alike = graph.op[first], graph.kind[first], graph.scope[first]
        arguments = tuple(graph.kind[a] for a in graph.args[first])
        return all(
            n in self.live
            and n not in self.place
            and n not in self.first
            and (graph.op[n], graph.kind[n], graph.scope[n]) == alike
            and tuple(graph.kind[a] for a in graph.args[n]) == arguments
            for n in nodes
        )

    @property
    def packs(self) -> list[Pack]:
        """All packs, each once."""
        return [pack for n, (pack, k) in self.place.items() if k == 0]

    def _unit(self, node: Node) -> Node:
        """What is computed at once with a node, by the number of its first."""
        place = self.place.get(node)
        return node if place is None else place[0].index

    def _order(self) -> list[Node]:
        """Units in an order of computation; those that wait for themselves are left out."""
        return ordered(self._needs(self._unit, self.live))[0]

    def _needs(self, unit_of: Callable[[Node], Node], nodes: set[Node]) -> dict[Node, set[Node]]:
        """Of the units of some nodes, the units that they need."""
        needs: dict[Node, set[Node]] = {}
        for node in nodes:
            needs.setdefault(unit_of(node), set()).update(map(unit_of, self.graph.args[node]))
        return needs

    def _dissolve_circles(self) -> bool:
        """Take apart some packs that wait for themselves, directly or by way of others."""
        needs = self._needs(self._unit, self.suspects)
        _, stuck = ordered(needs)
        users: dict[Node, set[Node]] = {unit: set() for unit in stuck}
        for unit in stuck:
            for a in needs[unit] & stuck:
                users[a].add(unit)
        _, circles = ordered(users)  # without what only waits for a circle
        packs = sorted(unit for unit in circles if unit in self.place)
        # What is in no circle now will be in none when packs are taken apart.
        self.suspects = {n for n in self.suspects if self._unit(n) in circles}
        for unit in packs[: max(1, len(packs) // 8)]:
            self._dissolve(self.place[unit][0])
        return bool(packs)

    def _dissolve(self, pack: Pack) -> None:
        for n in pack.nodes:
            del self.place[n]

    # --------------------------------------------------------------------------------- loops

    def _join(self) -> None:
        """Make loops of packs that feed each other."""
        self.rolls: list[Roll] = []
        needs: list[int] = []  # of each loop the loops that it waits for, as bits
        on: dict[Node, int] = {}  # of each unit the loops that it waits for or is in

        def reached(bits: int) -> int:
            seen = 0
            while bits & ~seen:
                low = (bits & ~seen) & -(bits & ~seen)
                seen |= low
                bits |= needs[low.bit_length() - 1]
            return seen

        for unit in self._order():
            if unit not in self.place:
                bits = 0
                for a in self.graph.args[unit]:
                    bits |= on[self._unit(a)]
                on[unit] = bits
                continue
            pack = self.place[unit][0]
            self._align(pack)
            chosen = None
            for number in reversed(range(len(self.rolls))):
                roll = self.rolls[number]
                bits = self._waits_for(pack, roll, on)
                if bits is not None and not reached(bits) >> number & 1:
                    chosen = number, roll, bits
                    break
            if chosen is None:
                roll = Roll(len(pack.nodes), self.graph.scope[unit])
                bits = self._waits_for(pack, roll, on)
                assert bits is not None
                chosen = len(self.rolls), roll, bits
                self.rolls.append(roll)
                needs.append(0)
            number, roll, bits = chosen
            pack.loop = roll
            roll.packs.append(pack)
            needs[number] |= bits & ~(1 << number)
            on[unit] = bits | 1 << number
            pack.args = [
                a.nodes if isinstance(a, Pack) and a.loop is not roll else a for a in pack.args
            ]

    def _waits_for(self, pack: Pack, roll: Roll, on: dict[Node, int]) -> int | None:
        """The loops that a pack waits for beside one that it may join; None if it may not."""
        if (roll.rounds, roll.scope) != (len(pack.nodes), self.graph.scope[pack.index]):
            return None
        bits = 0
        for arg in pack.args:
            if isinstance(arg, Pack):
                bits |= 0 if arg.loop is roll else on[arg.index]
                continue
            for node in arg if isinstance(arg, tuple) else (arg,):
                if node in self.place and self.place[node][0].loop is roll:
                    return None  # made in another round
                bits |= on[self._unit(node)]
        return bits

    def _align(self, pack: Pack) -> None:
        """Say of each argument whether it is one node, a pack, or a node for each round."""
        pack.args, pack.loop = [], None
        for nodes in zip(*(self.graph.args[n] for n in pack.nodes), strict=True):
            place = self.place.get(nodes[0])
            if len(set(nodes)) == 1:
                pack.args.append(nodes[0])
            elif place is not None and place[0].nodes == nodes:
                pack.args.append(place[0])
            else:
                pack.args.append(nodes)

    def _dissolve_small(self) -> bool:
        """Take apart loops that are short, or do less than it takes to gather what they need."""
        small = [
            r
            for r in self.rolls
            if r.rounds * len(r.packs) <= self.unroll
            or len(r.packs) < LEAST * max(1, self._cost(r))
        ]
        for roll in small:
            for pack in roll.packs:
                self._dissolve(pack)
        return bool(small)

    def _cost(self, roll: Roll) -> int:
        """How many arrays are to be written for a loop."""
        return sum(1 for nodes in roll.gathered if self.layout.stride(nodes) is None)

    def _mark_kept(self) -> None:
        """Mark what is read outside of its round."""
        read = [n for n in self.live if n not in self.place]
        outside = [a for n in read for a in self.graph.args[n]]
        for pack in self.packs:
            for arg in pack.args:
                if not isinstance(arg, Pack):
                    outside += arg if isinstance(arg, tuple) else (arg,)
        for node in (*outside, *self.roots):
            if node in self.place:
                self.place[node][0].kept = True

    # ------------------------------------------------------------------------------ schedule

    def schedule(self) -> dict[int, list[Node | Roll]]:
        """Nodes and loops of each scope in an order of computation."""
        head: dict[int, Node] = {}  # of each loop the number of its first node
        for roll in self.rolls:
            head[id(roll)] = roll.packs[0].index

        def unit_of(node: Node) -> Node:
            place = self.place.get(node)
            return node if place is None else head[id(place[0].loop)]

        needs = self._needs(unit_of, self.live)
        for unit, args in needs.items():
            args.discard(unit)
        order, stuck = ordered(needs)
        assert not stuck, "loops wait for each other"
        loops = {head[id(roll)]: roll for roll in self.rolls}
        out: dict[int, list[Node | Roll]] = defaultdict(list)
        for unit in order:
            out[self.graph.scope[unit]].append(loops.get(unit, unit))
        return out


def ordered(needs: Mapping[Node, set[Node]]) -> tuple[list[Node], set[Node]]:
    """Units so that each comes after what it needs, lowest first; and those of which none can."""
    users: dict[Node, list[Node]] = defaultdict(list)
    waits = {}
    for unit, args in needs.items():
        inside = [a for a in args if a in needs]
        waits[unit] = len(inside)
        for a in inside:
            users[a].append(unit)
    ready = [u for u, count in waits.items() if count == 0]
    heapq.heapify(ready)
    order = []
    while ready:
        unit = heapq.heappop(ready)
        order.append(unit)
        for user in users[unit]:
            waits[user] -= 1
            if waits[user] == 0:
                heapq.heappush(ready, user)
    return order, set(needs) - set(order)
