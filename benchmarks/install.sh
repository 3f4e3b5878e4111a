#!/usr/bin/env bash
# What an installation of the wheel costs: megabytes and seconds, with an empty and with a filled download cache, alone and
# with extras. The figures in docs/getting_started.md come from here.   Run: make dist && benchmarks/install.sh [EXTRA ...]
set -euo pipefail
cd "$(dirname "$0")/.."
uv=${UV:-.venv/bin/uv}
python=${PYTHON:-python3}
wheel=$(ls dist/softmode-*.whl)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

# install NAME CACHE: a new environment; prints seconds, megabytes on disk and the number of packages.
install() {
  local place="$scratch/venv" began ended
  rm -rf "$place"
  "$uv" venv --quiet --python "$python" "$place"
  began=$(date +%s.%N)
  "$uv" pip install --quiet --link-mode copy --cache-dir "$scratch/$2" --python "$place/bin/python" \
    --constraint constraints.txt "softmode${1:+[$1]} @ file://$PWD/$wheel"
  ended=$(date +%s.%N)
  printf '%-12s %-6s %6.1f s %6d MB %4d packages\n' "softmode${1:+[$1]}" "$2" "$(echo "$ended - $began" | bc)" \
    "$(du -sm "$place" | cut -f1)" "$("$uv" pip list --quiet --python "$place/bin/python" | tail -n +3 | wc -l)"
}

install '' cold
install '' cold | sed 's/cold /warm /'
for extra in "$@"; do
  install "$extra" cold | sed 's/cold /warm /'
done
