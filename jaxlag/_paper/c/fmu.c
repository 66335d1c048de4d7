/* The functions of FMI 3.0, model exchange and co-simulation, of a system of `model.h`. All code of the FMU is in this file. */
#include "model.h"
#include "model.c"
#include "mechanics.c"
#ifndef FMI3_FUNCTION_PREFIX /* of names, where several FMUs are linked together */
#define FMI3_FUNCTION_PREFIX PREFIX
#endif
#include "fmi3Functions.h"
#include <stdio.h>

#define MESSAGE_SIZE 512
#define FAR_OFF 1e-6 /* of a step, by which a communication point may differ from the time that was reached */

enum { INSTANTIATED = 1, INITIALISING = 2, IN_EVENT = 4, CONTINUOUS = 8, STEPPING = 16, TERMINATED = 32, FAILED = 64 };
enum { ANY = INSTANTIATED | INITIALISING | IN_EVENT | CONTINUOUS | STEPPING | TERMINATED };

typedef struct {
    Motion motion;
    int is_co_simulation;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

/* Logs a sentence. */
static fmi3Status failed(Instance *instance, fmi3Status status, const char *function, const char *sentence)
{
    char message[MESSAGE_SIZE];
    snprintf(message, sizeof message, "%s, t = %.17g: %s.", function, instance->motion.values[0], sentence);
    if (instance->log) instance->log(instance->environment, status, "logStatusError", message);
    if (status == fmi3Error) instance->motion.mode = FAILED;
    return status;
}

/* Where a variable is at fault. */
static fmi3Status refused(Instance *instance, const char *function, fmi3ValueReference variable, const char *sentence)
{
    char message[MESSAGE_SIZE];
    if (variable < SIZE) snprintf(message, sizeof message, "%s %s", NAMES[variable], sentence);
    else snprintf(message, sizeof message, "the value reference %lu %s", (unsigned long)variable, sentence);
    return failed(instance, fmi3Error, function, message);
}

/* Leaves a function that may not be called in the current mode. */
#define IN(modes)                                                                                            \
    do {                                                                                                     \
        if (!instance) return fmi3Error;                                                                     \
        if (!(((Instance *)instance)->motion.mode & (modes)))                                                \
            return failed(instance, fmi3Error, __func__, "the function must not be called in this mode");    \
    } while (0)

static int is_initial(const Motion *m)
{
    return m->mode == INSTANTIATED || m->mode == INITIALISING;
}

/* Everything that follows from the state; at the start, with the state itself. */
static const char *known(Motion *m)
{
    return m->mode == INITIALISING ? begin(m) : evaluate(m);
}

static void reset(Motion *m)
{
    memset(m, 0, sizeof *m);
    memcpy(m->values, START, sizeof START);
    memcpy(m->given, START + Q_AT, sizeof m->given);
    m->tolerance = DEFAULT_TOLERANCE;
    m->mode = INSTANTIATED;
}

static fmi3Instance instantiate(fmi3String token, int is_co_simulation, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    Instance *instance;
    if (!token || strcmp(token, TOKEN) != 0) {
        if (log) log(environment, fmi3Error, "logStatusError", "the instantiation token must be that of the model description");
        return NULL;
    }
    instance = calloc(1, sizeof *instance);
    if (!instance) return NULL;
    instance->environment = environment;
    instance->log = log;
    instance->is_co_simulation = is_co_simulation;
    reset(&instance->motion);
    return instance;
}

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories, const fmi3String categories[])
{
    (void)loggingOn, (void)nCategories, (void)categories; /* errors alone are logged, and always */
    IN(ANY | FAILED);
    return fmi3OK;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage)
{
    (void)instanceName, (void)resourcePath, (void)visible, (void)loggingOn;
    return instantiate(instantiationToken, 0, instanceEnvironment, logMessage);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
    const fmi3ValueReference requiredIntermediateVariables[], size_t nRequiredIntermediateVariables,
    fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate)
{
    (void)instanceName, (void)resourcePath, (void)visible, (void)loggingOn, (void)eventModeUsed, (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables, (void)nRequiredIntermediateVariables, (void)intermediateUpdate;
    return instantiate(instantiationToken, 1, instanceEnvironment, logMessage);
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance);
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance, fmi3Float64 startTime,
    fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    Motion *m = &((Instance *)instance)->motion;
    IN(INSTANTIATED);
    if (!isfinite(startTime)) return failed(instance, fmi3Error, __func__, "the start time must be finite");
    if (toleranceDefined && !(tolerance > 0)) return failed(instance, fmi3Error, __func__, "the tolerance must be positive");
    if (toleranceDefined) m->tolerance = fmin(fmax(tolerance, MARGIN * DBL_EPSILON), 1);
    m->duration = stopTimeDefined ? fmax(stopTime - startTime, 0) : 0;
    m->values[0] = startTime;
    m->is_projected = 0;
    forget(m);
    m->mode = INITIALISING;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    Motion *m = &((Instance *)instance)->motion;
    const char *failure;
    IN(INITIALISING);
    failure = begin(m);
    if (failure) return failed(instance, fmi3Error, __func__, failure);
    m->mode = ((Instance *)instance)->is_co_simulation ? STEPPING : IN_EVENT;
    return fmi3OK;
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    IN(CONTINUOUS);
    ((Instance *)instance)->motion.mode = IN_EVENT;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    IN(IN_EVENT | CONTINUOUS | STEPPING);
    ((Instance *)instance)->motion.mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    IN(ANY | FAILED);
    reset(&((Instance *)instance)->motion);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(
    fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences, fmi3Float64 values[], size_t nValues)
{
    Motion *m = &((Instance *)instance)->motion;
    IN(ANY);
    if (nValues != nValueReferences) return failed(instance, fmi3Error, __func__, "there must be one value for each variable");
    for (size_t i = 0; i < nValues; i++) {
        const fmi3ValueReference r = valueReferences[i];
        if (r >= SIZE) return refused(instance, __func__, r, "is that of no variable");
        if (r >= Z_AT && m->mode == INSTANTIATED) return refused(instance, __func__, r, "is not known before initialization");
        if (m->mode != INSTANTIATED && (r >= Z_AT || (r >= Q_AT && r < P_AT))) {
            const char *failure = r < Z_AT && m->mode != INITIALISING ? NULL : known(m);
            if (failure) return failed(instance, m->mode == INITIALISING ? fmi3Error : fmi3Discard, __func__, failure);
        }
        values[i] = m->mode == INSTANTIATED && r >= Q_AT && r < P_AT ? m->given[r - Q_AT] : m->values[r];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Float64 values[], size_t nValues)
{
    Motion *m = &((Instance *)instance)->motion;
    IN(INSTANTIATED | INITIALISING | IN_EVENT | CONTINUOUS | STEPPING);
    if (nValues != nValueReferences) return failed(instance, fmi3Error, __func__, "there must be one value for each variable");
    for (size_t i = 0; i < nValues; i++) {
        const fmi3ValueReference r = valueReferences[i];
        if (r >= SIZE) return refused(instance, __func__, r, "is that of no variable");
        if (r < Q_AT || r >= Z_AT) return refused(instance, __func__, r, "must not be set: it follows from others");
        if (r < P_AT && !is_initial(m)) return refused(instance, __func__, r, "must not be set after initialization");
        if (r >= P_AT && m->mode == CONTINUOUS && !IS_INPUT[r - P_AT]) return refused(instance, __func__, r, "must be set in event mode");
        if (!isfinite(values[i])) return refused(instance, __func__, r, "must be finite");
        *(r < P_AT ? m->given + r - Q_AT : m->values + r) = values[i];
        if (is_initial(m)) m->is_projected = 0;
        forget(m);
    }
    return fmi3OK;
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate, fmi3Boolean *terminateSimulation,
    fmi3Boolean *nominalsOfContinuousStatesChanged, fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
    fmi3Float64 *nextEventTime)
{
    Motion *m = &((Instance *)instance)->motion;
    const char *failure;
    IN(IN_EVENT);
    *discreteStatesNeedUpdate = *terminateSimulation = fmi3False;
    *nominalsOfContinuousStatesChanged = *valuesOfContinuousStatesChanged = *nextEventTimeDefined = fmi3False;
    *nextEventTime = 0;
    failure = accelerate(m);
    if (!failure && drift(m) > ROUNDING) {
        failure = project(m);
        *valuesOfContinuousStatesChanged = fmi3True;
    }
    return failure ? failed(instance, fmi3Error, __func__, failure) : fmi3OK;
}

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    IN(IN_EVENT);
    ((Instance *)instance)->motion.mode = CONTINUOUS;
    return fmi3OK;
}

/* A step that drifts off the constraints is followed by an event, which takes the state back. */
fmi3Status fmi3CompletedIntegratorStep(
    fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation)
{
    Motion *m = &((Instance *)instance)->motion;
    const char *failure;
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(CONTINUOUS);
    *terminateSimulation = fmi3False;
    failure = accelerate(m);
    if (failure) return failed(instance, fmi3Error, __func__, failure);
    *enterEventMode = !(drift(m) <= ON_CONSTRAINTS);
    return fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time)
{
    Motion *m = &((Instance *)instance)->motion;
    IN(IN_EVENT | CONTINUOUS);
    if (!isfinite(time)) return failed(instance, fmi3Error, __func__, "the time must be finite");
    m->values[0] = time;
    forget(m);
    return fmi3OK;
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[], size_t nContinuousStates)
{
    Motion *m = &((Instance *)instance)->motion;
    IN(IN_EVENT | CONTINUOUS);
    if (nContinuousStates != X_SIZE) return failed(instance, fmi3Error, __func__, "there must be one value for each state");
    for (int i = 0; i < X_SIZE; i++)
        if (!isfinite(continuousStates[i])) return refused(instance, __func__, Q_AT + i, "must be finite");
    memcpy(m->values + Q_AT, continuousStates, X_SIZE * sizeof *continuousStates);
    forget(m);
    return fmi3OK;
}

/* The state, or its rate, after what it follows from. */
static fmi3Status of_state(fmi3Instance instance, const char *function, double *values, size_t size, int is_rate)
{
    Motion *m = &((Instance *)instance)->motion;
    const char *failure = m->mode == INITIALISING ? begin(m) : is_rate ? accelerate(m) : NULL;
    if (size != X_SIZE) return failed(instance, fmi3Error, function, "there must be one value for each state");
    if (!failure && is_rate) failure = rate(m, values);
    if (failure) return failed(instance, m->mode == CONTINUOUS ? fmi3Discard : fmi3Error, function, failure);
    if (!is_rate) memcpy(values, m->values + Q_AT, X_SIZE * sizeof *values);
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t nContinuousStates)
{
    IN(INITIALISING | IN_EVENT | CONTINUOUS | TERMINATED);
    return of_state(instance, __func__, derivatives, nContinuousStates, 1);
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[], size_t nContinuousStates)
{
    IN(INITIALISING | IN_EVENT | CONTINUOUS | TERMINATED);
    return of_state(instance, __func__, continuousStates, nContinuousStates, 0);
}

/* What the coordinates are now and reach in a hundredth of the experiment, in units that weigh the same. */
fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t nContinuousStates)
{
    Motion *m = &((Instance *)instance)->motion;
    const double *x = m->values + Q_AT, brief = SHARE * (m->duration > 0 ? m->duration : 1);
    double of_q, of_v;
    const char *failure;
    IN(INITIALISING | IN_EVENT | CONTINUOUS | TERMINATED);
    if (nContinuousStates != X_SIZE) return failed(instance, fmi3Error, __func__, "there must be one value for each state");
    failure = known(m);
    if (failure) return failed(instance, fmi3Error, __func__, failure);
    of_v = fmax(reach(m, x + Q_SIZE), brief * reach(m, m->values + Z_AT));
    of_q = fmax(reach(m, x), brief * of_v);
    for (int i = 0; i < X_SIZE; i++) {
        double size = fmax(fabs(x[i]), i < 2 * Q_SIZE ? unit(m, i % Q_SIZE) * (i < Q_SIZE ? of_q : of_v) : 0);
        nominals[i] = size > 0 ? size : 1;
    }
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[], size_t nEventIndicators)
{
    (void)eventIndicators;
    IN(INITIALISING | IN_EVENT | CONTINUOUS | TERMINATED);
    return nEventIndicators == 0 ? fmi3OK : failed(instance, fmi3Error, __func__, "there are no event indicators");
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators)
{
    IN(ANY);
    *nEventIndicators = 0;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates)
{
    IN(ANY);
    *nContinuousStates = X_SIZE;
    return fmi3OK;
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    IN(0); /* event mode is not used in co-simulation */
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
    fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
    fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime)
{
    Motion *m = &((Instance *)instance)->motion;
    const double end = currentCommunicationPoint + communicationStepSize;
    const char *failure;
    double away;
    (void)noSetFMUStatePriorToCurrentPoint;
    IN(STEPPING);
    *eventHandlingNeeded = *terminateSimulation = *earlyReturn = fmi3False;
    *lastSuccessfulTime = m->values[0];
    if (!(communicationStepSize > 0) || !isfinite(end)) return failed(instance, fmi3Error, __func__, "the step must be positive and finite");
    away = fabs(currentCommunicationPoint - m->values[0]);
    if (away > FAR_OFF * communicationStepSize + MARGIN * DBL_EPSILON * fabs(end))
        return failed(instance, fmi3Error, __func__, "the communication point must be the time that was reached");
    failure = advance(m, end);
    *lastSuccessfulTime = m->values[0];
    return failure ? failed(instance, fmi3Error, __func__, failure) : fmi3OK;
}

/* The state of an instance is its `Motion`. */
fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    IN(ANY);
    if (!*FMUState) *FMUState = malloc(sizeof(Motion));
    if (!*FMUState) return failed(instance, fmi3Error, __func__, "there is no memory");
    memcpy(*FMUState, &((Instance *)instance)->motion, sizeof(Motion));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState)
{
    IN(ANY | FAILED);
    if (!FMUState) return failed(instance, fmi3Error, __func__, "there must be a state");
    memcpy(&((Instance *)instance)->motion, FMUState, sizeof(Motion));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    IN(ANY | FAILED);
    if (!FMUState) return fmi3OK;
    free(*FMUState);
    *FMUState = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size)
{
    (void)FMUState;
    IN(ANY);
    *size = sizeof(Motion);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size)
{
    IN(ANY);
    if (!FMUState || size < sizeof(Motion)) return failed(instance, fmi3Error, __func__, "there must be a state, and room for it");
    memcpy(serializedState, FMUState, sizeof(Motion));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size, fmi3FMUState *FMUState)
{
    IN(ANY);
    if (size != sizeof(Motion)) return failed(instance, fmi3Error, __func__, "the bytes must be those of a state of this FMU");
    if (!*FMUState) *FMUState = malloc(sizeof(Motion));
    if (!*FMUState) return failed(instance, fmi3Error, __func__, "there is no memory");
    memcpy(*FMUState, serializedState, sizeof(Motion));
    return fmi3OK;
}

/* Whether these may be unknowns and knowns of derivatives now. */
static fmi3Status differentiable(Instance *instance, const char *function, const fmi3ValueReference unknowns[], size_t nUnknowns,
    const fmi3ValueReference knowns[], size_t nKnowns)
{
    for (size_t i = 0; i < nUnknowns; i++)
        if (unknowns[i] < Q_AT || unknowns[i] >= SIZE) return refused(instance, function, unknowns[i], "is no unknown of derivatives");
    for (size_t i = 0; i < nKnowns; i++)
        if (knowns[i] >= Z_AT) return refused(instance, function, knowns[i], "is no known of derivatives");
    return fmi3OK;
}

/* The derivatives of all values along one seed. */
static fmi3Status along(Instance *instance, const char *function, const fmi3ValueReference knowns[], size_t nKnowns, const double *seed,
    double *dx)
{
    const char *failure = instance->motion.mode == INITIALISING ? begin(&instance->motion) : NULL;
    memset(dx, 0, SIZE * sizeof *dx);
    for (size_t i = 0; i < nKnowns; i++) dx[knowns[i]] += seed[i];
    if (!failure && instance->motion.mode == INITIALISING) failure = differentiate_start(&instance->motion, dx);
    if (!failure) failure = differentiate(&instance->motion, dx);
    return failure ? failed(instance, fmi3Error, function, failure) : fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[],
    size_t nSensitivity)
{
    double dx[SIZE];
    fmi3Status status;
    IN(INITIALISING | IN_EVENT | CONTINUOUS | STEPPING | TERMINATED);
    if (nSeed != nKnowns || nSensitivity != nUnknowns)
        return failed(instance, fmi3Error, __func__, "there must be one seed for each known, and one sensitivity for each unknown");
    status = differentiable(instance, __func__, unknowns, nUnknowns, knowns, nKnowns);
    if (status == fmi3OK) status = along(instance, __func__, knowns, nKnowns, seed, dx);
    for (size_t i = 0; status == fmi3OK && i < nUnknowns; i++) sensitivity[i] = dx[unknowns[i]];
    return status;
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[],
    size_t nSensitivity)
{
    const double one = 1;
    double dx[SIZE];
    fmi3Status status;
    IN(INITIALISING | IN_EVENT | CONTINUOUS | STEPPING | TERMINATED);
    if (nSeed != nUnknowns || nSensitivity != nKnowns)
        return failed(instance, fmi3Error, __func__, "there must be one seed for each unknown, and one sensitivity for each known");
    status = differentiable(instance, __func__, unknowns, nUnknowns, knowns, nKnowns);
    for (size_t i = 0; status == fmi3OK && i < nKnowns; i++) {
        status = along(instance, __func__, knowns + i, 1, &one, dx);
        sensitivity[i] = 0;
        for (size_t j = 0; j < nUnknowns; j++) sensitivity[i] += seed[j] * dx[unknowns[j]];
    }
    return status;
}

#include "unsupported.c"
