# nanogs as a command, on the files of this folder:
#   docker build -t nanogs .
#   docker run --rm --user "$(id -u)" -v "$PWD:/data" nanogs simplify scene.ply small.ply --ratio 0.1
FROM python:3.12-slim AS build
COPY . /src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels /src

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir /wheels/*.whl && rm -r /wheels

# Whoever runs it may add to what is compiled; the part made here holds on processors like this one.
# A container forgets what it compiles, so that this is what all presets and .sog files need.
ENV NUMBA_CACHE_DIR=/var/cache/nanogs
RUN nanogs demo /tmp/scene.ply --count 2000 \
    && nanogs simplify /tmp/scene.ply /tmp/small.ply --ratio 0.1 --preset best \
    && nanogs simplify /tmp/scene.ply /tmp/paper.ply --ratio 0.5 --preset paper \
    && nanogs convert /tmp/scene.ply /tmp/scene.sog \
    && rm /tmp/scene.* /tmp/small.ply /tmp/paper.ply \
    && chmod -R a+rwX "$NUMBA_CACHE_DIR"

RUN useradd --create-home nanogs && mkdir /data && chown nanogs /data
USER nanogs
WORKDIR /data
ENTRYPOINT ["nanogs"]
