#!/bin/sh
# Does the tasks of a campaign that have no result yet as Slurm arrays: slurm_array.sh DIR [OPTION OF SBATCH]...
#
# Days first, then sums, level by level, each once what comes before has ended, well or not: a task whose inputs are
# missing says so. After tasks were killed, start it again. At the end: `dragfree campaign commit DIR`.
# What the tasks say is in DIR/slurm.
set -eu
if [ $# -eq 0 ]; then
    echo "usage: $0 DIR [OPTION OF SBATCH]..." >&2
    exit 2
fi
folder=$(cd "$1" && pwd)
shift
# By its path: a site may give jobs another PATH.
program=$(command -v dragfree) || {
    echo "$0: there is no dragfree on the PATH" >&2
    exit 1
}
# Numbers of an array's tasks are smaller than this.
longest=$(scontrol show config | sed -n 's/^MaxArraySize *= *\([0-9]*\).*/\1/p')
mkdir -p "$folder/slurm"

# One line per array: level, number of the plan's line before its first one, tasks counted from there, `1-7,9`.
arrays() {
    FOLDER=$folder LONGEST=$longest awk '
        function has_result(id,    path, line, there) {
            path = ENVIRON["FOLDER"] "/results/" id "/result.json"
            while ((getline line < path) > 0) if (line ~ /"failed": null/) there = 1
            close(path)
            return there
        }
        function end_range() {
            if (last) tasks = tasks (tasks == "" ? "" : ",") first (last > first ? "-" last : "")
            last = 0
        }
        function end_array() {
            end_range()
            if (tasks != "") print level, offset, tasks
            tasks = ""
        }
        {
            id = match($0, /"id":"[0-9a-f]+"/) ? substr($0, RSTART + 6, RLENGTH - 7) : ""
            if (has_result(id)) next
            this = match($0, /"kind":"sums","level":[0-9]+/) ? substr($0, RSTART + 22, RLENGTH - 22) : "days"
            if (NR == 1 || this != level || NR - offset >= ENVIRON["LONGEST"] + 0) {
                end_array()
                level = this
                offset = NR - 1
            }
            if (last != NR - offset - 1) end_range()
            if (!last) first = NR - offset
            last = NR - offset
        }
        END { end_array() }
    ' "$folder/plan.jsonl"
}

quoted() {
    printf "'%s'" "$(printf '%s' "$1" | sed "s/'/'\\\\''/g")"
}

todo=$(arrays)
if [ -z "$todo" ]; then
    echo "every task has a result"
    exit 0
fi
task="exec $(quoted "$program") --quiet --threads 1 campaign task $(quoted "$folder")"
level=
jobs=   # of this level, `:1:2`
before= # of the level before
while read -r this offset tasks; do
    if [ "$this" != "$level" ]; then
        before=$jobs
        jobs=
        level=$this
    fi
    job=$(sbatch --parsable ${before:+"--dependency=afterany$before"} --array="$tasks" --job-name=dragfree \
        --output="$folder/slurm/%A_%a.log" "$@" --wrap="$task --number \$((SLURM_ARRAY_TASK_ID + $offset))" < /dev/null)
    job=${job%%;*} # `;` and the cluster follow where there are several
    jobs=$jobs:$job
    echo "job $job: tasks $tasks from line $offset of the plan"
done <<ARRAYS
$todo
ARRAYS
