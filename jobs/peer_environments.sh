#!/usr/bin/env bash
# A virtual environment per peer that python -m negopipe.benchmark.peers compares negopipe with, from the pins in
# jobs/peers. They cannot share one: their pins contradict each other and negopipe's. Needs Python 3.11; 6 GB in all, most of
# it torch, more with its build for CUDA, which pip takes unless it is told otherwise.
#   bash jobs/peer_environments.sh                     all of them, in build/peers
#   bash jobs/peer_environments.sh build/peers vmas    some of them
set -euo pipefail
here=$(dirname "$0")
folder=${1:-build/peers}
names=("${@:2}")
if [ ${#names[@]} -eq 0 ]; then
  for pins in "$here"/peers/*.txt; do names+=("$(basename "$pins" .txt)"); done
fi
for name in "${names[@]}"; do
  if [ ! -f "$here/peers/$name.txt" ]; then
    echo "a peer must be one of $(cd "$here/peers" && echo *.txt | sed 's/\.txt//g'), got $name" >&2
    exit 1
  fi
done
for name in "${names[@]}"; do
  "${PYTHON:-python3.11}" -m venv "$folder/$name"
  "$folder/$name/bin/python" -m pip install --quiet --disable-pip-version-check --requirement "$here/peers/$name.txt"
  echo "$folder/$name"
done
