#!/usr/bin/env bash
# The main line: the paper's two tasks, once with each setting leading the report.
# Results: outputs/yield/<run>/ and outputs/push/<run>/, report.html in each.
set -euo pipefail
python -m negopipe +experiment=yield
python -m negopipe +experiment=push
