#!/bin/sh
# Shows, stops or releases the robot by curl: `sh robot.sh state`, `stop` or `clear`.
# ADDRESS and TOKEN in the environment name another robot.
# The exit code is 0 only if the robot answers and obeys.
set -e

robot=${ADDRESS:-http://127.0.0.1:8080}
robot=${robot%/} # the page prints its address with a slash at the end

ask() {
    curl --silent --show-error --fail-with-body --max-time 5 --write-out '\n' \
        ${TOKEN:+--header "Authorization: Bearer $TOKEN"} "$@"
}

case ${1:-state} in
state)
    ask "$robot/api/state"
    ;;
stop)
    ask --request POST "$robot/api/srv/stop"
    ;;
clear)
    # The numbers of the causes in the state tell the robot what you have seen. The robot does not release a later stop.
    state=$(ask "$robot/api/state")
    numbers=$(echo "$state" | grep -o '"number": *[0-9]*' | grep -o '[0-9]*$' | paste -s -d , -)
    ask --json "{\"numbers\": [$numbers]}" "$robot/api/srv/clear"
    ;;
*)
    echo "usage: sh robot.sh [state | stop | clear]" >&2
    exit 64
    ;;
esac
