# nanogs as a command, on the files of this folder:
#   docker build -t nanogs .
#   docker run --rm --user "$(id -u)" -v "$PWD:/data" nanogs simplify scene.ply small.ply --ratio 0.1
# On ARM:
#   docker build --build-arg CPU=generic -t nanogs .
FROM python:3.12-slim AS build
COPY . /src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /src

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && rm -r /wheels

# Kernels are compiled for a processor by its name and features, and no other takes them. So they are
# for one that most machines can stand in for, wherever this is built: with AVX2, as since 2013 (Haswell,
# Zen). A container forgets what it compiles, so that everything is compiled here.
ARG CPU=x86-64-v3
ENV NUMBA_CACHE_DIR=/var/cache/nanogs NUMBA_CPU_NAME=${CPU} NUMBA_CPU_FEATURES=""
RUN nanogs warm && chmod -R a+rwX "$NUMBA_CACHE_DIR"

RUN useradd --create-home nanogs && mkdir /data && chown nanogs /data
USER nanogs
WORKDIR /data
ENTRYPOINT ["nanogs"]
