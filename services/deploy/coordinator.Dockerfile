# The coordinator, with ignctl beside it. Needs no libtorch. Build context: the repository.
FROM rust:1.95-slim-bookworm AS build
WORKDIR /src
COPY . .
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/src/target \
    cargo build --release --locked -p ign-coordinator -p ignctl \
    && install -D -t /out target/release/ign-coordinator target/release/ignctl

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates curl \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --create-home --home-dir /var/lib/ign ign \
    && install -d -o ign /var/lib/ign/tokens
COPY --from=build /out/ /usr/local/bin/
COPY services/deploy/with-secrets.sh /usr/local/bin/with-secrets
USER ign
EXPOSE 7070
ENTRYPOINT ["with-secrets", "ign-coordinator"]
