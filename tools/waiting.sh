#!/bin/sh
# waiting.sh WORDS COMMAND...: runs a command; on a terminal the words count its seconds, for it may be silent for long.
set -eu
words=$1
shift
if ! [ -t 1 ]; then
	echo "$words ..."
	exec "$@"
fi
"$@" &
running=$!
trap 'kill "$running" 2>/dev/null' INT TERM
begin=$(date +%s)
while kill -0 "$running" 2>/dev/null; do
	printf '\r%s, %d s' "$words" $(($(date +%s) - begin))
	sleep 0.5
done
echo
wait "$running"
