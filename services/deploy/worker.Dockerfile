# The worker: agent, bakes, renderer. Build context: the repository.
FROM rust:1.95-slim-bookworm AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
# libtorch changes far less often than the sources.
COPY worker/setup-libtorch.sh worker/
RUN IGN_CACHE_DIR=/opt/ign-cache worker/setup-libtorch.sh
COPY . .
RUN IGN_CACHE_DIR=/opt/ign-cache worker/setup-libtorch.sh
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/src/target \
    cargo build --release --locked -p ign-worker \
    && install -D -t /out/target/release target/release/ign-worker \
    && mkdir -p /out/.libtorch/lib \
    && cd .libtorch/lib \
    && cp -L libtorch_cpu.so libc10.so libgomp*.so* libcudart.so* libcupti.so* /out/.libtorch/lib/

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 10001 --create-home --home-dir /var/lib/ign ign
# The worker finds libtorch relative to itself, as in a checkout.
COPY --from=build /out/ /opt/ign/
COPY services/deploy/with-secrets.sh /usr/local/bin/with-secrets
RUN ln -s /opt/ign/target/release/ign-worker /usr/local/bin/ign-worker && install -d -o ign /var/lib/ign/work /var/lib/ign/tokens
USER ign
ENTRYPOINT ["with-secrets", "ign-worker"]
