"""The functions that an entry calls, kept on disk one by one: the next kind of problem compiles only what is new.

They are kept as LLVM's bitcode, optimised one by one, without machine code; see `isolation.as_one`.
"""

import logging
import pickle
import time
from typing import Any

from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult

from lqrsim.codegen import disk_cache as disk

logger = logging.getLogger("lqrsim")

WORTH = 0.05  # s; what compiles faster is not worth a file
WHAT = "parts that solvers share"


class KeptPart(NullCache):
    """What numba asks for a compiled function before it compiles, and gives it to after.

    Args:
      key: a hash of the function's text and of all that it calls. Its name has to be unique, too: linked into an entry,
        functions of the same name are taken for one.
      machine: what else the result depends on.
    """

    def __init__(self, key: str, machine: str) -> None:
        self._key, self._machine = key, machine
        self._begun: dict[str, float] = {}

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        stored = disk.load(self._name(sig))
        if stored is not None:
            try:
                return CompileResult._rebuild(target_context, *pickle.loads(stored))
            except Exception as error:  # whatever is wrong with it, it can be compiled again
                logger.debug(f"a compiled function in the cache could not be used ({error})")
        self._begun[str(sig)] = time.perf_counter()
        return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        if time.perf_counter() - self._begun.pop(str(sig)) < WORTH:
            return
        if cres.library.has_dynamic_globals or cres.lifted:  # addresses of this process
            return
        description = cres.fndesc
        description.typemap = description.calltypes = None  # cannot be pickled, and are not needed any more
        state = (
            cres.library.serialize_using_bitcode(), description, cres.environment, cres.signature, cres.objectmode,
            cres.lifted, "", cres.reload_init, tuple(cres._find_referenced_environments()),
        )  # fmt: skip
        try:
            contents = serialize.dumps(state)
        except Exception as error:  # it is compiled again by the next process
            logger.debug(f"a compiled function could not be kept ({error})")
            return
        disk.save(self._name(sig), contents, WHAT, shrink=False)

    def _name(self, sig: Any) -> str:
        return disk.key("part", self._machine, self._key, str(sig))
