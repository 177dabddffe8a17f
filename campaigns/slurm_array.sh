#!/bin/sh
# Does the tasks of a campaign as Slurm arrays: slurm_array.sh DIR
# Days first, then sums, level by level, each when what it reads is there. Run `dragfree campaign commit DIR` at the end.
set -eu
folder=$1
plan=$folder/plan.jsonl
after=
submit() { # FIRST LAST: lines of the plan
    after=$(sbatch --parsable ${after:+--dependency=afterok:$after} --array="$1-$2" --job-name=dragfree \
        --wrap="dragfree --quiet --threads 1 campaign task '$folder' --number \$SLURM_ARRAY_TASK_ID")
    echo "lines $1 to $2: job $after"
}
first=1
kind=
number=0
while IFS= read -r line; do
    number=$((number + 1))
    # `"kind":"day"`, `"kind":"flight"`, or `"kind":"sums"` with its level.
    this=$(printf '%s' "$line" | sed -n 's/.*"kind":"sums","level":\([0-9]*\).*/sums \1/p')
    if [ "$number" -gt 1 ] && [ "$this" != "$kind" ]; then
        submit "$first" $((number - 1))
        first=$number
    fi
    kind=$this
done < "$plan"
[ "$number" -gt 0 ] && submit "$first" "$number"
