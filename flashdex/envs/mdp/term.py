"""Terms: rewards, terminations and observations that carry their own options.

A decorator registers a function or a small class. Its keyword-only arguments are the
options that a recipe may set, `number(...)` gives their ranges, and the Args of its
docstring say what they mean. Recipes, masks, the assist's gates, logs and the page of
options read what is declared here; there is no second table.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, dataclass
from typing import Any, Literal, TypeVar, get_args

from flashdex.errors import FlashdexError, UnknownNameError
from flashdex.system.fields import number

Kind = Literal["transforms", "rewards", "terminations"]
KINDS: tuple[Kind, ...] = get_args(Kind)
Gate = Literal["task", "imitation", "cloning"]
"""What a reward says of the policy to the assist, which fades by it."""
M = TypeVar("M", bound=Callable[..., Any])

__all__ = ["allow", "find_term", "number", "observation", "reward", "termination"]

# Columns of the observation, as in section 6 of the method; other blocks follow.
_LAYOUT = (
    *("proprioception", "reference_delta", "object_state", "object_points"),
    *("surface_distance", "contact", "future_window"),
)
_TARGET = "_target_"
_LARGE = 1_000_000  # range of a number that declares none, either side
_ALLOWED = {"flashdex", "torchrl"}
_TERMS: dict[Kind, dict[str, Term]] = {kind: {} for kind in KINDS}


@dataclass(frozen=True, kw_only=True)
class Term:
    """One registered part of an environment and what it declares."""

    kind: Kind  # mapping of a recipe in which it is named
    name: str  # by which it is named
    make: Callable[..., Any]  # the decorated function or class
    about: str  # what it is, one paragraph
    options: type  # dataclass of its options; a reward's begin with its weight
    # from what the function reads to its arguments; None passes it as it is
    inputs: Callable[[Any], tuple[Any, ...]] | None = None
    needs_object: bool = False  # zero where the hand has no object
    gate: Gate | None = None  # mean that the assist waits for
    off: bool = False  # off unless a recipe turns it on
    # a reward that reads the failures of its own step; its weight is not shared between
    # the hands
    on_failure: bool = False
    in_evaluation: bool = False  # a termination that ends evaluations, too
    sums: Gate | None = None  # gate of the reward that a termination cannot do without

    @property
    def is_shipped(self) -> bool:
        """Whether it is part of flashdex, and so of every recipe."""
        return self.make.__module__.startswith("flashdex.")

    def bind(self, context: Any, options: Mapping[str, Any]) -> Callable[[Any], Any]:
        """Return the term as a function of a step; a class is made from ``context``."""
        make, inputs = self.make, self.inputs
        if isinstance(make, type):
            return make(context, **options)
        if inputs is None:
            return lambda step: make(step, **options)
        return lambda step: make(*inputs(step), **options)


def reward(name: str = "", *, weight: float = 1.0, **declared: Any) -> Callable[[M], M]:
    """Register a reward: a step to one number a world and hand, (N, 2).

    Args:
        name: in recipes and logs; that of the function when empty.
        weight: listed weight, of which each hand gets half; may be a `number(...)`.
        declared: fields of `Term`.
    """
    return _register("rewards", name, weight, **declared)


def termination(name: str = "", **declared: Any) -> Callable[[M], M]:
    """Register a termination: a step to the hands that failed, (N, 2) bool.

    Hands without a part in the motion never fail. ``declared`` are fields of `Term`.
    """
    return _register("terminations", name, **declared)


def observation(name: str = "", **declared: Any) -> Callable[[M], M]:
    """Register an observation: an assembled state to features, (N, 2, D).

    A function of a TensorDict or a `Block`. ``declared`` are fields of `Term`.
    """
    return _register("transforms", name, **declared)


def _register(
    kind: Kind, name: str, weight: float | None = None, **declared: Any
) -> Callable[[M], M]:
    def add(make: M) -> M:
        about = inspect.cleandoc(make.__doc__ or "").split("\n\n")[0]
        term = Term(
            kind=kind,
            name=name or make.__name__,
            make=make,
            about=" ".join(about.split()),
            options=_options_of(make, weight),
            **declared,
        )
        known = _TERMS[kind].get(term.name)
        if known is not None and known.make.__module__ != make.__module__:
            raise FlashdexError(
                f"{make.__module__}: there is a {kind[:-1]} '{term.name}' already, in "
                f"{known.make.__module__}. Give it another name."
            )
        _TERMS[kind][term.name] = term
        return make

    return add


def _options_of(make: Callable[..., Any], weight: float | None) -> type:
    """Make a dataclass of the keyword-only arguments, and plain defaults of theirs."""
    call: Any = make.__init__ if isinstance(make, type) else make
    texts = {"weight": "Listed weight."} | _argument_texts(make.__doc__)
    given = inspect.signature(call).parameters.values()
    fields = []
    for p in [p for p in given if p.kind == p.KEYWORD_ONLY]:
        field = _field(p.default, texts.get(p.name, ""), p.annotation)
        fields.append((p.name, p.annotation, field))
        if isinstance(p.default, Field):
            call.__kwdefaults__[p.name] = p.default.default
    if weight is not None:
        fields.insert(0, ("weight", float, _field(weight, texts["weight"], float)))
    return dataclasses.make_dataclass(
        f"{make.__name__}_options",
        fields,
        frozen=True,
        kw_only=True,
        namespace={"__module__": make.__module__},
    )


def _field(default: Any, text: str, kind: Any) -> Any:
    if not isinstance(default, Field) and re.search(r"\b(int|float)\b", str(kind)):
        default = number(default, low=-_LARGE, high=_LARGE)
    ranges = dict(default.metadata) if isinstance(default, Field) else {}
    value = default.default if isinstance(default, Field) else default
    value = MISSING if value is inspect.Parameter.empty else value
    return dataclasses.field(default=value, metadata={**ranges, "text": text})


def _argument_texts(doc: str | None) -> dict[str, str]:
    """Read what a docstring says of each argument, one line each."""
    _, _, arguments = inspect.cleandoc(doc or "").partition("\nArgs:\n")
    found = re.findall(r"^ {4}(\w+): (.+(?:\n {8}.+)*)", arguments, re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in found}


@functools.cache
def _load_shipped() -> None:
    for package in ("flashdex.envs.mdp", "flashdex.envs.transforms"):
        for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
            importlib.import_module(f"{package}.{module.name}")


def registry(kind: Kind) -> dict[str, Term]:
    """Return every registered term of a kind by name, in the order of recipes."""
    _load_shipped()
    known = _TERMS[kind]
    return {n: known[n] for n in (*_LAYOUT, *known) if n in known}


def default_mapping(kind: Kind) -> dict[str, dict[str, Any] | None]:
    """Return every shipped term of a kind with no option set (None = off)."""
    known = registry(kind).values()
    return {term.name: None if term.off else {} for term in known if term.is_shipped}


def allow(*packages: str) -> None:
    """Let recipes name terms of other packages, which are then imported and run."""
    _ALLOWED.update(packages)


def find_term(kind: Kind, name: str, options: Mapping[str, Any]) -> Term:
    """Return the term of a name, or of the `_target_` among its options.

    Raises:
        FlashdexError: there is none, or its package is not allowed.
    """
    if _TARGET in options:
        return _import_term(kind, str(options[_TARGET]))
    known = registry(kind)
    if name not in known:
        raise UnknownNameError(name, known, where=f"env.{kind}")
    return known[name]


def _import_term(kind: Kind, target: str) -> Term:
    module, _, name = target.rpartition(".")
    package = target.split(".")[0]
    if not any(f"{module}.".startswith(f"{known}.") for known in _ALLOWED):
        raise FlashdexError(
            f"'{target}' is code of the package '{package}', which is not allowed. If "
            f"you trust it, add --allow {package} to the command, or call "
            f"flashdex.envs.mdp.allow('{package}') in Python. The recipe of a run does "
            "not allow it: resuming and evaluating need it again."
        )
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:
        raise FlashdexError(
            f"'{target}' cannot be imported: {type(error).__name__}: {error}. Install "
            "its package, or put its folder on PYTHONPATH."
        ) from error
    for term in registry(kind).values():
        if term.make is found:
            return term
    decorator = "observation" if kind == "transforms" else kind[:-1]
    raise FlashdexError(f"'{target}' is no {kind[:-1]}; write @{decorator}() above it")


def terms_of(
    kind: Kind, mapping: Mapping[str, Mapping[str, Any] | None]
) -> dict[str, tuple[Term, dict[str, Any]]]:
    """Return the terms that a recipe has on, with the values of all their options."""
    found = {}
    for name, options in mapping.items():
        term = find_term(kind, name, options or {})
        if options is not None:
            own = {key: value for key, value in options.items() if key != _TARGET}
            found[name] = term, dataclasses.asdict(term.options(**own))
    return found
