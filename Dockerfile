# Understudy's own images, three targets of one file:
#   operator  the operator and the command line, without ROS
#   monitor   the same with ROS 2 Jazzy from PyPI: monitor, agent and the managed discovery server
#   tracker   the monitor's image with OpenCV, needed only to supervise robots by a camera
#
# The system and the dependencies change rarely, so they have their own layers: a change of the code rebuilds one small layer.
# pip's settings for a network (an index, a certificate) can be given as the secrets `pip` and `ca`; they do not become part of the image.
ARG BASE_IMAGE=python:3.12-slim

FROM ${BASE_IMAGE} AS base
# A user without rights and without a home; ROS writes its log below HOME.
# The standard library is compiled here, because official images of Python contain no bytecode of it. In the cluster the root is
# read-only, so bytecode could not be stored, and each process would compile its imports when it starts.
RUN groupadd --gid 65532 understudy && \
    useradd --uid 65532 --gid 65532 --no-create-home --home-dir /tmp --shell /usr/sbin/nologin understudy && \
    python3 -m venv /opt/understudy && \
    python3 -m compileall -q --invalidation-mode unchecked-hash -x '/(ensurepip|idlelib|lib2to3|tests?|tkinter|turtledemo|(site|dist)-packages)/' \
        "$(python3 -c 'import sysconfig; print(sysconfig.get_path("stdlib"))')"
ENV HOME=/tmp \
    PATH=/opt/understudy/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
    PIP_CONFIG_FILE=/run/secrets/pip \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_NO_CACHE_DIR=1 \
    PYTHONUNBUFFERED=1

# Only the lists of requirements, so that other changes of pyproject.toml do not install everything again. They have hashes, and pip
# installs nothing else: what it builds, it builds with the setuptools of these lists (--no-build-isolation).
FROM base AS requirements
COPY pyproject.toml constraints.txt docker/requirements.py /requirements/
RUN cd /requirements && \
    python requirements.py . --build >build.txt && \
    python requirements.py . operator >operator.txt && \
    python requirements.py . operator ros >monitor.txt && \
    python requirements.py . operator ros tracker >tracker.txt && \
    touch --date=@0 *.txt

FROM base AS tools
COPY --from=requirements /requirements/build.txt /tmp/build/
RUN --mount=type=secret,id=pip --mount=type=secret,id=ca \
    pip install --quiet --require-hashes --requirement /tmp/build/build.txt

FROM tools AS operator-dependencies
COPY --from=requirements /requirements/operator.txt /tmp/build/
RUN --mount=type=secret,id=pip --mount=type=secret,id=ca \
    pip install --quiet --use-pep517 --no-build-isolation --require-hashes --requirement /tmp/build/operator.txt

FROM operator-dependencies AS monitor-dependencies
COPY --from=requirements /requirements/monitor.txt /tmp/build/
RUN --mount=type=secret,id=pip --mount=type=secret,id=ca \
    pip install --quiet --use-pep517 --no-build-isolation --require-hashes --requirement /tmp/build/monitor.txt
COPY docker/ros-environment docker/understudy-discovery-server /usr/local/bin/
ENV RMW_IMPLEMENTATION=rmw_fastrtps_cpp

FROM monitor-dependencies AS tracker-dependencies
COPY --from=requirements /requirements/tracker.txt /tmp/build/
RUN --mount=type=secret,id=pip --mount=type=secret,id=ca \
    pip install --quiet --use-pep517 --no-build-isolation --require-hashes --requirement /tmp/build/tracker.txt

FROM tools AS wheel
COPY pyproject.toml README.md LICENSE /source/
COPY operator /source/operator
RUN pip wheel --quiet --use-pep517 --no-deps --no-build-isolation --no-index --wheel-dir /wheel /source

FROM tracker-dependencies AS tracker
COPY --from=wheel /wheel /tmp/wheel
RUN pip install --quiet --no-deps --no-index /tmp/wheel/*.whl && rm -r /tmp/wheel /tmp/build
USER 65532:65532
ENTRYPOINT ["ros-environment", "understudy", "tracker"]

FROM operator-dependencies AS operator
COPY --from=wheel /wheel /tmp/wheel
RUN pip install --quiet --no-deps --no-index /tmp/wheel/*.whl && rm -r /tmp/wheel /tmp/build
USER 65532:65532
ENTRYPOINT ["understudy"]

FROM monitor-dependencies AS monitor
COPY --from=wheel /wheel /tmp/wheel
RUN pip install --quiet --no-deps --no-index /tmp/wheel/*.whl && rm -r /tmp/wheel /tmp/build
USER 65532:65532
ENTRYPOINT ["ros-environment", "understudy"]
