"""Changes that a generator makes: one place of a file's source, the rest of which keeps its bytes."""

import ast
import re
from collections.abc import Iterator
from typing import NamedTuple


class Edit(NamedTuple):
    """`before`, which begins at this byte of a file, becomes `after`."""

    start: int
    line: int
    scope: str  # the function or class around it
    kind: str
    before: str
    after: str


NEIGHBOUR = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "=="}
NEIGHBOUR |= {"is": "is not", "is not": "is", "in": "not in", "not in": "in"}
OPPOSITE = NEIGHBOUR | {"<": ">=", "<=": ">", ">": "<=", ">=": "<"}
WHOLE = re.compile(r"^\d+$|\blen\(|\bnum_|count|shape|index|\brows?\b|\bframes?\b|position|number")
ARITHMETIC = {"+": "-", "-": "+", "*": "/", "/": "*", "//": "*", "%": "//", "**": "*", "|": "&"}
LOGIC = {"and": "or", "or": "and"}
OPERATOR = re.compile(rb"not\s+in|is\s+not|[a-z]+|[-+*/%<>=!&|@]+")
PATH = re.compile(r"folder|path|root|parent|file|\bout\b|CONF|PACKAGE", re.IGNORECASE)
NAMES = {"min": "max", "minimum": "maximum", "argmin": "argmax", "any": "all", "floor": "ceil", "sin": "cos"}
NAMES |= {"zeros": "ones", "zeros_like": "ones_like", "isfinite": "isnan"}
NAMES |= {other: name for name, other in NAMES.items()}
# f(x, …) and x.f() become x.
UNWRAPPED = "abs sqrt square exp log sorted reversed stop_gradient inv inverse clip normalize safe_normalize"
UNWRAPPED = {*UNWRAPPED.split(), *("round", "rint", "nan_to_num", "deg2rad", "radians", "cumsum", "copy")}
LIBRARIES = {"jnp", "np", "jax", "lax", "cv2", "sorted", "min", "max", "sum", "re", "json", "shutil", "subprocess"}
# What only says something, what decides how a result is computed and not which, and the numbers of invented scenery.
WORDS = re.compile(r"print|(logging|log|logger|warnings|tqdm)\.\w+|\w+\.(set_description|set_postfix)")
KEPT = {"dtype", "strict", "encoding", "precision", "length", "check", "text", "indent", "preferred_element_type"}
SIZES = "__all__ GROUP CURVE_BITS BLOCK NUM_NEAR MIN_RUN MAX_POINTS _MERGE_ROWS _BAND_ROWS MAX_BYTES"
SIZES = {*SIZES.split(), *("NUM_SIZES", "WORDS_AT_ONCE", "LEAST_LISTED")}
SCENERY = re.compile(r"emgs_jax/data/(plan|furniture|furnishing|walks|looks|room)\.py")
GUARD = (ast.Raise, ast.Return, ast.Continue)
STATEMENTS = {ast.Expr: "pass", ast.AugAssign: "pass", ast.Break: "continue", ast.Continue: "break"}
Change = tuple[int, int, str, str]  # start, end, what stands there instead, kind


def edits(source: str, file: str = "") -> Iterator[Edit]:
    """All changes of a file's source; a few may not compile, or be none."""
    for edit in Finder(source).found(ast.parse(source), ""):
        if not (edit.kind == "constant" and SCENERY.match(file)):
            yield edit


def changed(source: str, edit: Edit) -> str:
    """The source with this change.

    Raises:
        ValueError: another text stands at its place.
    """
    data, before = source.encode(), edit.before.encode()
    if data[edit.start : edit.start + len(before)] != before:
        raise ValueError(f"line {edit.line} is not what it was: {edit.before!r}")
    return (data[: edit.start] + edit.after.encode() + data[edit.start + len(before) :]).decode()


class Finder:
    """Knows where the nodes of a source stand; counts bytes, as `ast` does."""

    def __init__(self, source: str) -> None:
        self._data = source.encode()
        self._lines = [0]
        for line in self._data.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))

    def found(self, node: ast.AST, scope: str) -> Iterator[Edit]:
        """Changes of this node and of what is inside it."""
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            scope = f"{scope}.{node.name}".strip(".")
        for start, end, after, kind in (*self._of_expression(node), *self._of_statement(node)):
            line = self._data.count(b"\n", 0, start) + 1
            yield Edit(start, line, scope, kind, self._data[start:end].decode(), after)
        for child in inside(node):
            yield from self.found(child, scope)

    def _start(self, node) -> int:
        return self._lines[node.lineno - 1] + node.col_offset

    def _end(self, node) -> int:
        return self._lines[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node) -> str:
        return self._data[self._start(node) : self._end(node)].decode()

    def _whole(self, node, after: str, kind: str) -> Change:
        return self._start(node), self._end(node), after, kind

    def _swapped(self, first, second, kind: str) -> Change:
        gap = self._data[self._end(first) : self._start(second)].decode()
        return self._start(first), self._end(second), f"{self._text(second)}{gap}{self._text(first)}", kind

    def _between(self, left, right, words: dict[str, str], kind: str) -> Iterator[Change]:
        """The operator between two operands becomes `words[operator]`."""
        begin = self._end(left)
        match = OPERATOR.search(self._data[begin : self._start(right)])
        if match and match[0].decode() in words:
            yield begin + match.start(), begin + match.end(), words[match[0].decode()], kind

    def _of_expression(self, node: ast.AST) -> Iterator[Change]:
        match node:
            case ast.Compare(left=first, comparators=others):
                for left, right in zip([first, *others], others, strict=False):
                    # Two real numbers are hardly ever equal, so `<` and its neighbour are the same there.
                    is_whole = WHOLE.search(self._text(left)) or WHOLE.search(self._text(right))
                    yield from self._between(left, right, NEIGHBOUR if is_whole else OPPOSITE, "comparison")
            case ast.BoolOp(values=values):
                for left, right in zip(values, values[1:], strict=False):
                    yield from self._between(left, right, LOGIC, "logic")
            case ast.BinOp(op=ast.BitAnd()):
                for side in (node.left, node.right):
                    yield self._whole(node, f"({self._text(side)})", "mask")
            case ast.BinOp(op=ast.MatMult()):
                yield self._whole(node, f"({self._text(node.right)}) @ ({self._text(node.left)})", "order")
            case ast.BinOp(left=left, right=right) if not (is_no_number(left) or is_no_number(right)):
                if not (isinstance(node.op, ast.Div) and PATH.search(self._text(left))):
                    yield from self._between(left, right, ARITHMETIC, "arithmetic")
            case ast.UnaryOp(operand=operand) if not isinstance(operand, ast.Constant):
                yield self._whole(node, f"({self._text(operand)})", "negation")
            case ast.Constant(value=bool(value)):
                yield self._whole(node, str(not value), "constant")
            case ast.Constant(value=int(value) | float(value)) if value == 0 or value > 1e-4:
                yield self._whole(node, str(2 * value or type(value)(1)), "constant")
            case ast.comprehension(ifs=tests):
                yield from (self._whole(test, "True", "mask") for test in tests)
            case ast.Subscript(slice=index):
                for part in index.elts if isinstance(index, ast.Tuple) else [index]:
                    if re.fullmatch(r"-?\d+", self._text(part)):
                        yield self._whole(part, "1" if self._text(part) == "0" else "0", "slice")
            case ast.Slice(lower=lower, upper=upper):
                for bound, step in ((lower, "+ 1"), (upper, "- 1")):
                    if bound:
                        yield self._whole(bound, f"({self._text(bound)}) {step}", "slice")
            case ast.Call():
                yield from self._of_call(node)

    def _of_call(self, node: ast.Call) -> Iterator[Change]:
        function, end = node.func, self._end(node.func)
        name = getattr(function, "attr", getattr(function, "id", ""))
        if name in NAMES:
            yield end - len(name), end, NAMES[name], "name"
        if name in ("set", "add") and ".at[" in self._text(function):
            yield end - 3, end, "add" if name == "set" else "set", "name"
        if name == "where" and len(node.args) == 3:
            yield self._swapped(*node.args[1:], "where")
        if name in UNWRAPPED and (node.args or isinstance(function, ast.Attribute)):
            yield self._whole(node, f"({self._text(node.args[0] if node.args else function.value)})", "unwrapped")
        for keyword in node.keywords:
            if keyword.arg == "axis":
                if re.fullmatch(r"-?\d+", self._text(keyword.value)):
                    yield self._whole(keyword.value, "-1" if self._text(keyword.value) == "0" else "0", "axis")
            elif keyword.arg not in KEPT and self._text(function).split(".")[0] in LIBRARIES:
                comma = self._data.rfind(b",", end, self._start(keyword))
                yield max(comma, end + 1), self._end(keyword), "", "keyword"

    def _of_statement(self, node: ast.AST) -> Iterator[Change]:
        if type(node) in STATEMENTS:
            yield self._whole(node, STATEMENTS[type(node)], "statement")
        match node:
            case ast.If(body=[statement], orelse=[]) if isinstance(statement, GUARD):
                if self._text(node).startswith("if"):  # and not `elif`
                    yield self._whole(node, "pass", "statement")
            case ast.Return(value=ast.Tuple(elts=values)):
                yield from (self._swapped(*pair, "tuple") for pair in zip(values, values[1:], strict=False))
            case ast.FunctionDef():
                yield from self._of_assignments(node)

    def _of_assignments(self, function: ast.FunctionDef) -> Iterator[Change]:
        """Yield changes that leave out an assignment: to a name that has a value already, or inside an object."""
        known = {argument.arg for argument in ast.walk(function.args) if isinstance(argument, ast.arg)}
        statements = [child for child in ast.walk(function) if isinstance(child, ast.Assign)]
        for statement in sorted(statements, key=self._start):
            target = statement.targets[0]
            names = {child.id for child in ast.walk(target) if isinstance(child, ast.Name)}
            is_inside = isinstance(target, (ast.Attribute, ast.Subscript)) and function.name != "__init__"
            if names <= known or is_inside:
                yield self._whole(statement, "pass", "statement")
            known |= names


def is_no_number(node: ast.expr) -> bool:
    """Text and lists know no `-`, and `type | None` is no sum."""
    is_word = isinstance(node, ast.Constant) and not isinstance(node.value, (int, float))
    return is_word or isinstance(node, (ast.JoinedStr, ast.List, ast.Tuple))


def inside(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the parts of a node that may change: no annotation, decorator, text, message or compiled size."""
    match node:
        case ast.FunctionDef(args=args, body=parts):
            parts = [*args.defaults, *filter(None, args.kw_defaults), *parts]
        case ast.ClassDef(body=parts):
            pass
        case ast.AnnAssign(value=value):
            parts = [value] if value else []
        case (
            ast.Raise()
            | ast.Assert()
            | ast.JoinedStr()
            | ast.keyword(arg="axis" | "strict" | "exist_ok" | "high" | "disable")
        ):
            parts = []
        case ast.Assign(targets=[ast.Name(id=name)]) if name in SIZES:
            parts = []
        case ast.Call(func=ast.Attribute(attr=name), args=[ast.Subscript(), *parts]) if name.endswith("s_like"):
            pass  # whose shape is taken, and which row hardly ever has another
        case ast.Subscript(value=value, slice=index):  # its numbers have changes of their own
            parts = [value, *(index.elts if isinstance(index, ast.Tuple) else [index])]
            parts = [part for part in parts if not re.fullmatch(r"-?\d+", ast.unparse(part))]
        case ast.Slice():
            parts = [part for part in ast.iter_child_nodes(node) if not re.fullmatch(r"-?\d+", ast.unparse(part))]
        case _:
            parts = ast.iter_child_nodes(node)
    yield from (part for part in parts if not is_left_out(part))


def is_left_out(node: ast.AST) -> bool:
    """A docstring, a call that only says something, or what is for type checkers."""
    if isinstance(node, ast.Expr):
        call = ast.unparse(node.value.func) if isinstance(node.value, ast.Call) else ""
        return isinstance(node.value, (ast.Constant, ast.Yield)) or bool(WORDS.fullmatch(call))
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
