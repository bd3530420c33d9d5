# Verbs of the project; `just --list` shows them. CI runs the same ones (.ci/run).
# `just` itself comes with the development dependencies: `uv run just VERB`.

set shell := ["bash", "-euo", "pipefail", "-c"]

native_modules := "vtslam.common.splat._native vtslam.common.geometry._points vtslam.common.optim._align vtslam.common.shm._atomics vtslam.services.sensor.sources._raycast vtslam.services.sensor.sources._city vtslam.storage._coder"

_default:
    @just --list

# Make the environment: dependencies, native modules, the command `vtslam`
setup:
    uv sync

# Build the native modules again
build:
    uv sync --reinstall-package vtslam

# All tests
test *ARGS:
    uv run pytest {{ARGS}}

# Style of Python and C++
lint:
    uv run ruff check .
    uv run ruff format --check .
    git ls-files -z '*.cpp' '*.hpp' | xargs -0 uv run clang-format --dry-run --Werror

# Put the style right
fmt:
    uv run ruff check --fix .
    uv run ruff format .
    git ls-files -z '*.cpp' '*.hpp' | xargs -0 uv run clang-format -i

# Types, strict
types:
    uv run mypy

# Imports point one way: services -> storage -> common
imports:
    PYTHONPATH=src uv run lint-imports

# Write the stubs of the native modules again
stubs:
    @for module in {{native_modules}}; do \
      folder=${module%.*}; folder=${folder#vtslam.}; \
      uv run python -m nanobind.stubgen -q -m "$module" -O "${folder//.//}"; \
    done

# The committed stubs are those of the built modules
stubs-check:
    @out=$(mktemp -d); trap 'rm -rf "$out"' EXIT; \
    for module in {{native_modules}}; do \
      path=${module#vtslam.}; path=${path//.//}.pyi; \
      uv run python -m nanobind.stubgen -q -m "$module" -O "$out"; \
      diff "$path" "$out/${path##*/}" || { echo "$path is stale: run 'just stubs'" >&2; exit 1; }; \
    done

# A simulated room from frames to figures and pictures
demo OUT="vtslam-demo":
    uv run vtslam demo --out {{quote(OUT)}}
    test -s {{quote(OUT)}}/report.json

# Wheel and source package, into dist/
package:
    uv build

# Everything that must hold before a change goes in
check: lint types imports stubs-check test

# What CI does, on this checkout
ci:
    .ci/run
