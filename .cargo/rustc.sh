#!/bin/sh
# Runs rustc so that what it builds does not say where the sources of crates lie: `strength_reduce-0.2.4/src/lib.rs` in
# place of `/home/somebody/.cargo/registry/src/.../strength_reduce-0.2.4/src/lib.rs` in the text of a panic. A product
# states the digests of the plugins' libraries, and another user who builds the same sources gets the same ones.
# (cargo's own `trim-paths` is not in its stable version.)
if [ -n "${CARGO_MANIFEST_DIR-}" ] && [ -n "${CARGO_PKG_NAME-}" ]; then
    crate=$CARGO_PKG_NAME-${CARGO_PKG_VERSION-}
    set -- "$@" "--remap-path-prefix=$CARGO_MANIFEST_DIR=$crate"
    if [ -n "${OUT_DIR-}" ]; then
        set -- "$@" "--remap-path-prefix=$OUT_DIR=$crate/out"
    fi
fi
exec "$@"
