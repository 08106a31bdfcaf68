#!/bin/bash
# Start or stop PostgreSQL and an MLflow server in front of it, both on 127.0.0.1 only.
#
#     experiments/cluster/server.sh start FOLDER [PORT]    # prints the address for tracking.uri=
#     experiments/cluster/server.sh stop FOLDER
#
# FOLDER keeps the database, the artifacts, the logs and the password of the database. PORT is that of the
# server (5000); the database uses the next one. PYTHON names the interpreter, WORKERS the processes of the server (2).
set -euo pipefail

action=${1:?start or stop} folder=$(realpath -m "${2:?a folder}") port=${3:-5000}
python=${PYTHON:-python} programs=${POSTGRES:-$(ls -d /usr/lib/postgresql/*/bin | tail -1)}
log=$folder/server.log

database() {  # PostgreSQL refuses to run as root
    if [ "$(id -u)" = 0 ]; then (cd /; exec setpriv --reuid=postgres --regid=postgres --clear-groups "$@"); else "$@"; fi
}

start() {
    mkdir -p "$folder/artifacts" "$folder/database"
    if [ ! -e "$folder/database/PG_VERSION" ]; then
        (umask 077; head -c 24 /dev/urandom | base64 | tr '+/' '-_' >"$folder/password")
        [ "$(id -u)" != 0 ] || chown postgres "$folder/database" "$folder/password"
        database "$programs/initdb" --pgdata "$folder/database" --username skin --encoding UTF8 --no-locale \
            --auth scram-sha-256 --pwfile "$folder/password" >"$log"
    fi
    database "$programs/pg_ctl" --pgdata "$folder/database" --wait --timeout 300 --silent \
        --log "$folder/database/log" --options \
        "-c listen_addresses=127.0.0.1 -c port=$((port + 1)) -c unix_socket_directories= -c max_connections=200" start
    # In the environment, because anyone on this machine can read the arguments of a process.
    MLFLOW_BACKEND_STORE_URI=postgresql+pg8000://skin:$(cat "$folder/password")@127.0.0.1:$((port + 1))/postgres \
        MLFLOW_DISABLE_TELEMETRY=true MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false \
        setsid "$python" -m mlflow server --host 127.0.0.1 --port "$port" --workers "${WORKERS:-2}" \
        --serve-artifacts --artifacts-destination "$folder/artifacts" >>"$log" 2>&1 </dev/null &
    echo $! >"$folder/server.pid"
    for _ in $(seq 300); do
        if curl --silent --fail --max-time 5 "http://127.0.0.1:$port/health" >/dev/null; then
            echo "http://127.0.0.1:$port"
            return
        fi
        kill -0 "$(cat "$folder/server.pid")" || break
        sleep 1
    done
    echo "the server did not start: see $log" >&2
    exit 1
}

stop() {
    # The server is the leader of its process group.
    [ ! -e "$folder/server.pid" ] || kill -- -"$(cat "$folder/server.pid")" 2>/dev/null || true
    rm -f "$folder/server.pid"
    database "$programs/pg_ctl" --pgdata "$folder/database" --mode fast --silent stop
}

"$action"
