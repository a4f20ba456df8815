"""Array shapes and types are checked on every call while tests run, and only then."""

from jaxtyping import install_import_hook

install_import_hook(
    ["capture4d", "data_synth", "registration", "retarget", "wrinkles", "benchmarks"], "beartype.beartype"
)
