#!/bin/sh
# Sets NAME to the content of the file that NAME_FILE names, then becomes the command: secrets stay out of
# compose files, of `docker inspect` and of command lines.
set -eu
for name in AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY PGPASSWORD; do
    eval "file=\${${name}_FILE:-}"
    if [ -n "$file" ]; then
        value=$(cat "$file")
        export "$name=$value"
    fi
done
exec "$@"
