#!/bin/sh
# Makes the secrets that docker-compose.yml names, each a random word in a file of its own; existing ones stay.
set -eu
dir=$(cd "$(dirname "$0")" && pwd)/secrets
umask 077
mkdir -p "$dir"
for name in token postgres_password s3_access_key s3_secret_key; do
    if [ ! -s "$dir/$name" ]; then
        od -An -N24 -tx1 /dev/urandom | tr -d ' \n' >"$dir/$name"
        # The folder is closed to others; inside a container another user reads the file.
        chmod 444 "$dir/$name"
        echo "made $dir/$name" >&2
    fi
done
