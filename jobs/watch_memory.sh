#!/usr/bin/env bash
# Resident memory of a process and size of its run folder every 30 s until it ends: bash jobs/watch_memory.sh <pid> <run folder> <table.csv>
set -euo pipefail
pid=$1 folder=$2 table=$3
echo "seconds,resident_mb,folder_mb" > "$table"
while resident_kb=$(awk '/VmRSS/ {print $2}' "/proc/$pid/status" 2> /dev/null) && [ -n "$resident_kb" ]; do
  folder_kb=$(du -sk "$folder" | cut -f1)
  awk -v s="$(ps -o etimes= -p "$pid")" -v r="$resident_kb" -v f="$folder_kb" \
    'BEGIN {printf "%d,%.1f,%.1f\n", s, r / 1024, f / 1024}' >> "$table"
  sleep 30
done
