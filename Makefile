# The commands of this project. `make help` lists them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
HIPPODROME = HIPPODROME_STACK="$(STACK)" $(BIN)/python -m hippodrome
# --plan and --dry-run end with 3 if they have found something to do, which is no error.
FOUND = || { code=$$?; [ $$code -eq 3 ] || exit $$code; }
PROJECT ?=
DATA ?=
USER_ID ?=
PORT ?=
BOTS ?=
TEMPLATE ?=
STACK ?= hippodrome
DOMAIN ?=
EMAIL ?=
ARGS ?=
MINISTACK := .venv-ministack
AUDIT := .venv-audit
DOCS := .venv-docs
.DEFAULT_GOAL := help
# With the slash it is a folder, never an id. Without PROJECT= it is the study in this folder, the example.
STUDY = $(if $(strip $(PROJECT)),"$(PROJECT)/")
option = $(if $(strip $($(1))),--$(2) "$($(1))")# $(call option,DATA,from) is --from "FOLDER", or nothing without DATA=
# Shells have variables HOST, and may have TLS and NAMES: these three count only on make's command line.
typed = $(if $(filter command,$(origin $(1))),$(2))
WHERE = $(call typed,HOST,--host "$(HOST)") $(call typed,TLS,$(if $(filter-out 0,$(TLS)),--tls)) $(call typed,NAMES,--names "$(NAMES)")
# make itself ignores an unknown variable. AWS_… and HIPPODROME_… reach the commands by the environment.
KNOWN := PYTHON VENV BIN PROJECT TEMPLATE DATA USER_ID HOST PORT TLS NAMES BOTS STACK DOMAIN EMAIL ARGS MINISTACK AUDIT DOCS WORKERS TIMES SEED WITHIN
$(foreach name,$(filter-out $(KNOWN) AWS_% HIPPODROME_%,$(.VARIABLES)),$(if $(filter command,$(origin $(name))),\
	$(error There is no variable $(name) here, and nothing was run; there are $(KNOWN))))

# PROJECT=$STUDY with nothing in STUDY would be the example, and DATA= another folder than was meant.
$(foreach name,PROJECT DATA USER_ID TEMPLATE PORT BOTS STACK DOMAIN EMAIL,$(if $(filter command,$(origin $(name))),$(if $(strip $($(name))),,\
	$(error $(name)= has no value, and nothing was run: write one, or leave $(name)= out))))
# make itself would run the other commands first: `make check ../my-study` would check the example.
COMMANDS := $(if $(MAKECMDGOALS),$(shell sed -nE 's/^([a-z-]+):.*\#\# .*/\1/p' $(firstword $(MAKEFILE_LIST))))
$(foreach goal,$(filter-out $(COMMANDS) $(VENV)/% $(MINISTACK)/% $(AUDIT)/% $(DOCS)/%,$(MAKECMDGOALS)),\
	$(error There is no command $(goal) here, and nothing was run; `make help` lists the commands. For the study in a folder, \
	write: make $(or $(firstword $(filter $(COMMANDS),$(MAKECMDGOALS))),run) PROJECT=$(goal)))

.PHONY: help
help: ## list these commands
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

.PHONY: run try check gym new
run: $(VENV)/local ## run the study of PROJECT=. on this machine, its data in DATA=PROJECT/data, at PORT=8000
	@$(HIPPODROME) run $(STUDY) $(call option,DATA,data) $(call option,PORT,port) $(WHERE) $(ARGS)
try: $(VENV)/local ## send BOTS=20 simulated participants through the study of PROJECT=., their data in DATA=
	@$(HIPPODROME) try $(STUDY) $(call option,BOTS,bots) $(call option,DATA,data) $(ARGS)
gym: $(VENV)/local ## serve Gymnasium's environments to Gymie's clients and RemoteEnv, at PORT=5000 (docs/gym.md)
	@$(HIPPODROME) gym $(call option,PORT,port) $(WHERE) $(ARGS)
new: $(VENV)/local ## make a study of your own in PROJECT=../my-study from TEMPLATE= (without it: which there are)
	@$(HIPPODROME) new "$(PROJECT)" "$(TEMPLATE)"
check: $(VENV)/local ## find mistakes in config.yml, the step pages and agent.py of PROJECT=.
	@$(HIPPODROME) check $(STUDY) $(ARGS)

.PHONY: deploy plan register secret certificate doctor status cost data erase logs stop destroy
deploy: $(VENV)/deploy ## install on AWS (DOMAIN=, EMAIL=): the stack, its certificate, the study of PROJECT=.
plan: $(VENV)/deploy ## show what `make deploy` would change in the installation
register: $(VENV)/deploy ## register the study of PROJECT=. on AWS, or its new version
secret: $(VENV)/deploy ## keep the key of a language model on AWS (ARGS="set LLM_KEY")
certificate: $(VENV)/deploy ## order or renew the servers' certificate (ARGS=--production)
doctor: $(VENV)/deploy ## check that everything is in order on AWS, and say what to do if not
status: $(VENV)/deploy ## show participants' steps and servers (ARGS=--watch)
cost: $(VENV)/deploy ## compute what the study of PROJECT=. will cost (what it has cost: ARGS=--spent)
data: $(VENV)/deploy ## convert answers and recordings of PROJECT=. (DATA=) to CSV and Parquet, from here or AWS
erase: $(VENV)/deploy ## erase one participant, USER_ID=, from the data of PROJECT=. or DATA=, on this machine or AWS
logs: $(VENV)/deploy ## show the logs of functions and servers (ARGS=--errors)
stop: $(VENV)/deploy ## stop every server now, or those of PROJECT=
destroy: $(VENV)/deploy ## remove the installation; the data stay
deploy plan register cost: TOLD = $(STUDY)
deploy plan: TOLD += $(call option,DOMAIN,domain) $(call option,EMAIL,email)
plan: TOLD += --plan
doctor status logs stop: TOLD = $(or $(STUDY),--all)
data: TOLD = $(STUDY) $(call option,DATA,from)
erase: TOLD = $(call option,DATA,from)
erase: WHO = -- "$(USER_ID)" $(STUDY)
deploy plan register secret certificate doctor status cost data erase logs stop destroy:
	@$(HIPPODROME) $(subst plan,deploy,$@) $(TOLD) $(ARGS) $(WHO) $(FOUND)

WORKERS ?=
# Many tests wait for processes, so two cores have four workers. `loadscope` gives a worker the tests of a module.
PYTEST = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(or $(WORKERS),4) --dist loadscope
QUICK = $(filter-out tests/test_docs.py,$(wildcard tests/test_*.py)) tests/control tests/functions tests/protocol tests/trial/core \
	$(addprefix --ignore ,tests/control/aws tests/control/servers/test_sweep_strangers.py tests/control/test_moto_journey.py)

.PHONY: test
test: $(VENV)/dev $(MINISTACK)/ready ## run the tests
	@$(PYTEST)

.PHONY: quick
quick: $(VENV)/dev $(MINISTACK)/ready ## run the tests of the pure core and the services, in less than a minute
	@$(PYTEST) $(QUICK)

# With SEED=0 the examples differ each time; hypothesis prints the line that repeats a failure.
TIMES ?= 10
SEED ?= 0
WITHIN ?=
.PHONY: hunt
hunt: $(VENV)/dev $(MINISTACK)/ready ## explore for long: every fault point, TIMES=10 times as many examples (SEED= repeats them, WITHIN= ends it)
	@HUNT=$(TIMES) HUNT_SECONDS=$(WITHIN) $(PYTEST) -rs $(if $(filter-out 0,$(SEED)),--hypothesis-seed=$(SEED))

.PHONY: bench
bench: $(VENV)/dev ## measure, print a table, write bench/results.json
	@$(BIN)/python -m bench

.PHONY: lint
lint: $(VENV)/dev ## ruff and mypy
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

.PHONY: audit
audit: $(VENV)/dev $(AUDIT)/ready ## look for known vulnerabilities: bandit in the code, pip-audit (online) in the packages
	@$(AUDIT)/bin/bandit -c pyproject.toml -q -ll -r hippodrome lambdas deploy
	@$(AUDIT)/bin/pip-audit --strict --path "$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"

.PHONY: docs
docs: $(DOCS)/ready ## build the documentation's site in dist/docs/; a link that leads nowhere ends it
	@$(DOCS)/bin/sphinx-build -q -W --keep-going -c docs/site -d dist/doctrees . dist/docs
	@echo 'Open dist/docs/index.html in a browser.'

.PHONY: format
format: $(VENV)/dev ## format the code with ruff
	@$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

.PHONY: clean
clean: ## remove the virtual environments and caches; data/ stays
	rm -rf $(VENV) $(MINISTACK) $(AUDIT) $(DOCS) .pytest_cache .mypy_cache .ruff_cache .hypothesis shots dist

# NEWEST: the newest Python 3 for which all pinned packages have wheels. Intel Macs get older versions of some packages, in
# copies of the requirement files.
MACHINE := $(shell uname -sm)
ifeq ($(MACHINE),Darwin x86_64)
NEWEST := 13
REQUIREMENTS := $(VENV)/requirements
else
NEWEST := 14
REQUIREMENTS := requirements
endif
WHEELS := --only-binary ale-py,cryptography,h5py,isal,numpy,pillow,pyarrow,pydantic-core
INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check -c $(REQUIREMENTS)/constraints.txt
# Pip has printed what is missing (a wheel, the network); this sentence says on which machines it works.
NOT_INSTALLED = || { echo 'Not everything could be installed: see above. There are packages for Linux (x86-64 and ARM) and macOS, with' \
	'Python 3.11 to 3.$(NEWEST) on this machine ($(MACHINE)). With the right Python: rm -r $(VENV); make PYTHON=python3.$(NEWEST)'; exit 1; }

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, $(NEWEST)))' || \
		{ echo 'Hippodrome needs Python 3.11 to 3.$(NEWEST) on this machine ($(MACHINE)), since the packages that it uses have none for others;' \
		'try: make PYTHON=python3.$(NEWEST) $(MAKECMDGOALS)'; exit 1; }
	@echo 'Making a virtual environment in $(VENV) …'
	@$(PYTHON) -m venv $(VENV)

# In the copies, the lines of intel-mac.txt replace those for the same packages.
$(VENV)/requirements/%.txt: requirements/%.txt requirements/intel-mac.txt | $(VENV)/bin/python
	@mkdir -p $(@D)
	@awk 'NR == FNR { if ($$0 !~ /^#/) { split($$0, pin, "=="); older[pin[1]] = $$0 } next } \
		{ split($$0, pin, "=="); if (pin[1] in older) print older[pin[1]]; else print $$0 }' requirements/intel-mac.txt $< > $@

$(VENV)/local: pyproject.toml $(patsubst %,$(REQUIREMENTS)/%.txt,local trial lambdas constraints) | $(VENV)/bin/python
	@echo 'Installing what a study needs (once; a minute or two) …'
	@$(INSTALL) $(WHEELS) -r $(REQUIREMENTS)/local.txt $(NOT_INSTALLED)
	@$(INSTALL) --no-deps --editable . $(NOT_INSTALLED)
	@touch $@

$(VENV)/deploy: $(REQUIREMENTS)/deploy.txt $(VENV)/local
	@echo 'Installing what tables of data and AWS need (once; a minute or two) …'
	@$(INSTALL) $(WHEELS) -r $(REQUIREMENTS)/deploy.txt $(NOT_INSTALLED)
	@touch $@

# The emulator's functions run with the packages of its environment, so it has one of its own.
$(MINISTACK)/ready: requirements/ministack.txt
	@echo 'Installing the emulator of AWS that the tests use (once) …'
	@$(PYTHON) -m venv $(MINISTACK)
	@$(MINISTACK)/bin/pip install --quiet --disable-pip-version-check -r requirements/ministack.txt
	@touch $@

$(AUDIT)/ready: requirements/audit.txt
	@echo 'Installing bandit and pip-audit (once) …'
	@$(PYTHON) -m venv $(AUDIT)
	@$(AUDIT)/bin/pip install --quiet --disable-pip-version-check -r requirements/audit.txt
	@touch $@

$(DOCS)/ready: requirements/docs.txt
	@echo 'Installing Sphinx (once) …'
	@$(PYTHON) -m venv $(DOCS)
	@$(DOCS)/bin/pip install --quiet --disable-pip-version-check -r requirements/docs.txt
	@touch $@

$(VENV)/dev: $(REQUIREMENTS)/dev.txt $(VENV)/deploy
	@echo 'Installing what the tests need (once) …'
	@$(INSTALL) $(WHEELS) -r $(REQUIREMENTS)/dev.txt $(NOT_INSTALLED)
	@touch $@
