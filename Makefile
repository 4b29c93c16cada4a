# What the README names. Every target prints the commands that it runs; all of them work in plain sh.
#
#   make bake                       bake a generated demo capture, embedded: no service, no account, no GPU needed
#   make bake CAPTURE=dir [OBJECT=collection/object] [PRESET=auto|standard|paper] [OUT=dir] [ARGS="--size 128 ..."]
#   make test                       everything: formats, lints, all tests; ends with "N passed, N failed"
#   make lint                       formats and lints alone
#   make setup                      libtorch into the per-user cache, linked as .libtorch
#   make fuzz TARGET=name [SECS=60]  one parser under libFuzzer; needs cargo-fuzz, see tests/fuzz
#   make ablation [CAPTURES="dir ..."] [ARGS="--seeds 1 --budget-secs 10"]  what each part of the recipe is worth
#   make pretrain                   the weights that every CompositionNet starts from, on generated captures
#   make bench [BENCH=name] [ARGS="--views 20 --rounds 1"]   speed beside a peer, one case or all; see tests/bench

.POSIX:
.PHONY: bake test lint bench ablation pretrain fuzz setup build

CARGO = cargo
# One profile serves baking and testing: the numeric code is optimised in it, and nothing is compiled twice.
BIN = $${CARGO_TARGET_DIR:-target}/debug

CAPTURE =
OBJECT =
PRESET = standard
OUT =
ARGS =
BENCH =
TARGET =
CAPTURES =
SECS = 60
# The demo finishes within four minutes on two cores.
DEMO_ARGS = --size 128 --budget-secs 90

bake: build
	@set -eu; bin=$(BIN); capture='$(CAPTURE)'; object='$(OBJECT)'; out='$(OUT)'; limits=; \
	if [ -z "$$capture" ]; then \
		capture=bake-out/demo-capture; object=$${object:-demo/vase}; limits='$(DEMO_ARGS)'; \
		if [ ! -e "$$capture/test.txt" ]; then \
			echo "bake: generating a demo capture in $$capture"; \
			rm -rf "$$capture"; mkdir -p bake-out; \
			"$$bin/ign-worker" demo-capture "$$capture"; \
		fi; \
	fi; \
	if [ -z "$$object" ]; then \
		name=$$(basename "$$capture" | tr 'A-Z' 'a-z' | tr -c 'a-z0-9\n' '-' | sed 's/^-*//; s/-*$$//'); \
		object=local/$${name:-object}; \
	fi; \
	out=$${out:-bake-out/$${object#*/}}; \
	echo "bake: $$capture as $$object, preset $(PRESET), into $$out"; \
	IGN_DATA=$${IGN_DATA:-bake-out/data} "$$bin/ignctl" bake "$$capture" --object "$$object" \
		--preset '$(PRESET)' --out "$$out" $$limits $(ARGS)

build: setup
	$(CARGO) build --locked -p ignctl -p ign-coordinator -p ign-worker

test:
	python3 .ci/test.py

lint: setup
	$(CARGO) fmt --all --check
	$(CARGO) clippy --workspace --all-targets --locked -- -D warnings

# Without captures of one's own: matte, glossy, mirror-like, and one that breaks the rule that light stays still.
ablation: build
	@set -eu; bin=$(BIN); out=bake-out/ablation; captures='$(CAPTURES)'; \
	if [ -z "$$captures" ]; then \
		demo() { \
			captures="$$captures $$out/captures/$$1"; \
			if [ ! -e "$$out/captures/$$1/test.txt" ]; then \
				rm -rf "$$out/captures/$$1"; mkdir -p "$$out/captures"; \
				"$$bin/ign-worker" demo-capture "$$out/captures/$$1" --size 128 --views 64 $$2; \
			fi; \
		}; \
		demo matte '--gloss 0'; demo glossy '--gloss 0.6 --seed 1'; \
		demo mirror '--shape sphere --gloss 1 --seed 2'; demo turntable '--shape bowl --gloss 0.6 --seed 3 --turntable'; \
	fi; \
	"$$bin/ign-worker" experiment ablation $$captures --out "$$out" --size 96 $(ARGS)

# Seeds from 100 on are for this alone: no test and no demonstration uses them.
pretrain: build
	@set -eu; bin=$(BIN); out=bake-out/pretrain; seed=100; \
	for off in 0 0.8; do for gloss in 0 0.3 0.6 0.9; do for shape in vase bowl sphere; do \
		seed=$$((seed + 1)); size=$$((96 + 96 * (seed % 2))); capture=$$out/$$shape-$$seed; \
		if [ ! -e "$$capture/test.txt" ]; then \
			rm -rf "$$capture"; mkdir -p "$$out"; \
			"$$bin/ign-worker" demo-capture "$$capture" --shape "$$shape" --gloss "$$gloss" --seed "$$seed" --size "$$size" --views 64 \
				--misregistration "$$off"; \
		fi; \
	done; done; done; \
	"$$bin/ign-worker" pretrain "$$out"/*-1* --out worker/bake/pretrained/composition.safetensors --size 96 \
		--set effects_steps=300 --set composition_steps=12000 --set patch=64 --set batch=4 --set optimizer=adam $(ARGS)

bench:
	python3 tests/bench/run.py $(BENCH) $(ARGS)

fuzz: setup
	cp Cargo.lock tests/fuzz/fuzz/Cargo.lock
	mkdir -p tests/fuzz/fuzz/corpus/$(TARGET)
	cd tests/fuzz && RUSTC_BOOTSTRAP=1 $(CARGO) fuzz run --sanitizer none $(TARGET) \
		fuzz/corpus/$(TARGET) corpus/$(TARGET) -- -max_total_time=$(SECS) -rss_limit_mb=2048

setup:
	worker/setup-libtorch.sh
